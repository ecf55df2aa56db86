"""Compiled part of the confidence: do other frames see the same depth?"""

from __future__ import annotations

from numba import njit

AGREEMENT = 0.06  # relative difference of depths that agree ...
AGREEMENT_PX = 0.7  # ... or their difference in the image


@njit(cache=True, nogil=True)
def ask(own, pixels_per_unit, other, second_from_first, K, agree, asked):
    """Count in how many frames a pixel is seen (asked), and in how many the depth is the same."""
    height, width = own.shape
    R, t = second_from_first[:, :3], second_from_first[:, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for i in range(height):
        y = (i - cy) / fy
        for j in range(width):
            w = own[i, j]
            if w <= 0:
                continue
            x = (j - cx) / fx
            Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + t[2] * w
            if Z <= 1e-6:
                continue
            u = fx * (R[0, 0] * x + R[0, 1] * y + R[0, 2] + t[0] * w) / Z + cx
            v = fy * (R[1, 0] * x + R[1, 1] * y + R[1, 2] + t[1] * w) / Z + cy
            if not (0 <= u < width - 1 and 0 <= v < height - 1):
                continue
            asked[i, j] += 1
            seen, expected = other[int(v + 0.5), int(u + 0.5)], w / Z
            gap = abs(seen - expected)
            if gap < AGREEMENT * expected or gap * pixels_per_unit[i, j] < AGREEMENT_PX:
                agree[i, j] += 1
