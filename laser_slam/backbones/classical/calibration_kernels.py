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

NUM_SHARED = 3  # relative focal length, k1, k2


@njit(cache=True, nogil=True)
def shared_jacobian(x, y, intrinsics, pixel, huber, out):
    """Fill (2, 3): weighted derivatives of the pixel of ray (x, y, 1) by focal length, k1, k2."""
    r2 = x * x + y * y
    radial = 1 + r2 * (intrinsics[4] + r2 * intrinsics[5])
    u, v = distorted(x, y, intrinsics)
    e = np.sqrt((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2)
    weight = 1.0 if e <= huber else np.sqrt(huber / e)
    for i, part in enumerate((weight * intrinsics[0] * x, weight * intrinsics[1] * y)):
        out[i, 0], out[i, 1], out[i, 2] = part * radial, part * r2, part * r2 * r2


@njit(cache=True, nogil=True)
def shared_equations(rotations, translations, points, cameras, starts, pixels, intrinsics, huber):
    """Set up the normal equations of cameras and calibration, the points eliminated.

    Returns:
        (6C, 6C) of the cameras, lower blocks; (6C, 3) between cameras and calibration; (3, 3) of
        the calibration; (6C,) and (3,) right-hand sides.
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
