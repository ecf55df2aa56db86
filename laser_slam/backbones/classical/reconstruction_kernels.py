"""Compiled part of the reconstruction; arguments as in `bundle_kernels`."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def triangulate(rotations, translations, has_pose, cameras, starts, pixels, intrinsics):
    """Return (P, 3) points nearest to their rays, and (P,) angles; 0: no point.

    An angle is the widest between the first ray and another, in radians.
    """
    num = starts.shape[0] - 1
    points, angles = np.zeros((num, 3)), np.zeros(num)
    for point in range(num):
        A, b = np.zeros((3, 3)), np.zeros(3)
        first, views, cosine = np.zeros(3), 0, 1.0
        for o in range(starts[point], starts[point + 1]):
            c = cameras[o]
            if not has_pose[c]:
                continue
            ray = np.array(
                [
                    (pixels[o, 0] - intrinsics[2]) / intrinsics[0],
                    (pixels[o, 1] - intrinsics[3]) / intrinsics[1],
                    1.0,
                ]
            )
            ray = rotations[c].T @ (ray / np.sqrt((ray * ray).sum()))
            centre = -(rotations[c].T @ translations[c])
            across = np.eye(3) - np.outer(ray, ray)
            A += across
            b += across @ centre
            if views == 0:
                first = ray
            cosine = min(cosine, (first * ray).sum())
            views += 1
        angle = np.arccos(max(-1.0, cosine))
        if views >= 2 and angle > 1e-5:
            points[point] = np.linalg.solve(A, b)
            angles[point] = angle
    return points, angles
