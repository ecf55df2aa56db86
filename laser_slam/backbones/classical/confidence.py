"""How far a depth can be trusted: geometry of the views, agreement between frames, matching."""

from __future__ import annotations

import numpy as np
from numba import njit

from laser_slam.backbones.classical.sweep import Float, Sweep, View
from laser_slam.sim3 import Array

MATCHING_PX = 0.35  # error of a match
TRUSTED_RELATIVE_ERROR = 0.08  # depth error at which the geometric confidence is one half
AGREEMENT = 0.06  # relative difference of depths that agree ...
AGREEMENT_PX = 0.7  # ... or their difference in the image
PARTNERS = (-3, -2, -1, 1, 2, 3)  # frames that are asked
UNIQUE_BITS = 12.0
WORST_COST, COST_RANGE = 11.0, 5.0  # bits


def confidences(
    views: list[View], sweeps: list[Sweep | None], wanted: list[int], K: Array
) -> list[Float]:
    """Rate the depths of the wanted frames against those of the frames around them.

    Args:
        views: frames in order.
        sweeps: one each; None: this frame was not swept.
        wanted: which frames to rate; each was swept.
        K: (3, 3) intrinsics of the depth maps.

    Returns:
        (H, W) in [0, 1] each; calibrated so that about 90 % of the pixels above 0.5 err by less
        than a tenth of their depth.
    """
    return [_confidence(views, sweeps, frame, K) for frame in wanted]


def _confidence(views: list[View], sweeps: list[Sweep | None], frame: int, K: Array) -> Float:
    own = sweeps[frame]
    assert own is not None
    motion_px = np.maximum(own.pixels_per_unit * own.inverse_depth, 1e-6)
    geometry = 1.0 / (1.0 + (MATCHING_PX / motion_px / TRUSTED_RELATIVE_ERROR) ** 2)
    agree, asked = np.zeros_like(own.cost), np.zeros_like(own.cost)
    for offset in PARTNERS:
        if not 0 <= frame + offset < len(views):
            continue
        other = sweeps[frame + offset]
        if other is not None:
            mapping = relative_pose(views[frame], views[frame + offset])
            _ask(
                own.inverse_depth,
                own.pixels_per_unit,
                other.inverse_depth,
                mapping,
                K,
                agree,
                asked,
            )
    consistency = agree / np.maximum(asked, 2.0)
    unique = np.clip(own.uniqueness / UNIQUE_BITS / 4.0, 0, 1)
    match = np.clip((WORST_COST - own.cost) / COST_RANGE, 0, 1)
    out = geometry * consistency**1.5 * np.sqrt(unique * match)
    out[own.is_far] = 0
    return np.asarray(out, np.float32)


def relative_pose(first: View, second: View) -> Array:
    """Return (3, 4) second_from_first."""
    R = second.rotation @ first.rotation.T
    return np.column_stack([R, second.translation - R @ first.translation])


@njit(cache=True, nogil=True)
def _ask(own, pixels_per_unit, other, second_from_first, K, agree, asked):  # type: ignore[no-untyped-def]  # noqa: PLR0913
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
