"""Compiled part of self-calibration; arguments as in `bundle_kernels`."""

from __future__ import annotations

import numpy as np
from numba import njit

from laser_slam.backbones.classical.bundle_kernels import (
    MIN_DEPTH,
    distorted,
    eliminate_points,
    linearise,
    normal_equations,
)

NUM_SHARED = 7  # relative focal length, centre x, y in focal lengths, k1, k2, p1, p2


@njit(cache=True, nogil=True)
def shared_jacobian(x, y, intrinsics, pixel, huber, out):
    """Fill (2, 7): weighted derivatives of the pixel of ray (x, y, 1) by the shared unknowns."""
    r2 = x * x + y * y
    u, v = distorted(x, y, intrinsics)
    e = np.sqrt((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2)
    weight = 1.0 if e <= huber else np.sqrt(huber / e)
    fx, fy = weight * intrinsics[0], weight * intrinsics[1]
    out[0, 0], out[1, 0] = weight * (u - intrinsics[2]), weight * (v - intrinsics[3])
    out[0, 1], out[1, 1] = fx, 0.0
    out[0, 2], out[1, 2] = 0.0, fy
    out[0, 3], out[1, 3] = fx * x * r2, fy * y * r2
    out[0, 4], out[1, 4] = fx * x * r2 * r2, fy * y * r2 * r2
    out[0, 5], out[1, 5] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    out[0, 6], out[1, 6] = fx * (r2 + 2 * x * x), fy * 2 * x * y


@njit(cache=True, nogil=True)
def shared_equations(rotations, translations, points, cameras, starts, pixels, intrinsics, huber):
    """Set up the normal equations of cameras and calibration, the points eliminated.

    Returns:
        (6C, 6C) of the cameras, lower blocks; (6C, 7) between cameras and calibration; (7, 7) of
        the calibration; (6C,) and (7,) right-hand sides.
    """
    num_cams, num = rotations.shape[0], points.shape[0]
    S, s = np.zeros((6 * num_cams, 6 * num_cams)), np.zeros(6 * num_cams)
    W = np.zeros((cameras.shape[0], 6, 3))
    V, b, V_inv = np.zeros((num, 3, 3)), np.zeros((num, 3)), np.zeros((num, 3, 3))
    normal_equations(
        rotations, translations, points, cameras, starts, pixels, intrinsics, huber, S, s, W, V, b
    )
    eliminate_points(cameras, starts, W, V, b, 0.0, S, s, V_inv)
    H, g = np.zeros((NUM_SHARED, NUM_SHARED)), np.zeros(NUM_SHARED)
    cross = np.zeros((6 * num_cams, NUM_SHARED))
    J_cam, J_point, r = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros(2)
    J = np.zeros((2, NUM_SHARED))
    for point in range(num):
        E = np.zeros((NUM_SHARED, 3))
        for o in range(starts[point], starts[point + 1]):
            R, t = rotations[cameras[o]], translations[cameras[o]]
            X = R @ points[point] + t
            if X[2] <= MIN_DEPTH:
                continue
            linearise(R, t, points[point], pixels[o], intrinsics, huber, J_cam, J_point, r)
            shared_jacobian(X[0] / X[2], X[1] / X[2], intrinsics, pixels[o], huber, J)
            c = 6 * cameras[o]
            for i in range(NUM_SHARED):
                g[i] -= J[0, i] * r[0] + J[1, i] * r[1]
                for j in range(3):
                    E[i, j] += J[0, i] * J_point[0, j] + J[1, i] * J_point[1, j]
                for j in range(NUM_SHARED):
                    H[i, j] += J[0, i] * J[0, j] + J[1, i] * J[1, j]
                for j in range(6):
                    cross[c + j, i] += J_cam[0, j] * J[0, i] + J_cam[1, j] * J[1, i]
        F = E @ V_inv[point]
        H -= F @ E.T
        g -= F @ b[point]
        for o in range(starts[point], starts[point + 1]):
            c = 6 * cameras[o]
            for i in range(6):
                for j in range(NUM_SHARED):
                    cross[c + i, j] -= (
                        W[o, i, 0] * F[j, 0] + W[o, i, 1] * F[j, 1] + W[o, i, 2] * F[j, 2]
                    )
    return S, cross, H, s, g
