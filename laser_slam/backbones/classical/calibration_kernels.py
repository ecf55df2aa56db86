"""Compiled part of self-calibration; arguments as in `bundle_kernels`."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit

from laser_slam.backbones.classical.bundle_kernels import distorted, linearise

NUM_SHARED = 3  # relative focal length, k1, k2


@njit(cache=True, nogil=True)
def _shared_jacobian(x, y, intrinsics, weight, out):
    """Fill (2, 3): derivatives of the pixel of ray (x, y, 1) by focal length, k1, k2."""
    r2 = x * x + y * y
    radial = 1 + r2 * (intrinsics[4] + r2 * intrinsics[5])
    for i, part in enumerate((weight * intrinsics[0] * x, weight * intrinsics[1] * y)):
        out[i, 0], out[i, 1], out[i, 2] = part * radial, part * r2, part * r2 * r2


@njit(cache=True, nogil=True)
def shared_equations(rotations, translations, points, cameras, starts, pixels, intrinsics, huber):
    """Return the normal equations (6C + 3) of cameras and calibration, the points eliminated."""
    first = 6 * rotations.shape[0]
    H, g = np.zeros((first + NUM_SHARED, first + NUM_SHARED)), np.zeros(first + NUM_SHARED)
    J_cam, J_point, r = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros(2)
    J = np.zeros((2, NUM_SHARED))
    for point in range(points.shape[0]):
        start, num = starts[point], starts[point + 1] - starts[point]
        V, b = 1e-12 * np.eye(3), np.zeros(3)
        W, E = np.zeros((num, 6, 3)), np.zeros((NUM_SHARED, 3))
        for k in range(num):
            R, t, pixel = (
                rotations[cameras[start + k]],
                translations[cameras[start + k]],
                pixels[start + k],
            )
            linearise(R, t, points[point], pixel, intrinsics, huber, J_cam, J_point, r)
            X = R @ points[point] + t
            u, v = distorted(X[0] / X[2], X[1] / X[2], intrinsics)
            e = np.sqrt((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2)
            weight = 1.0 if e <= huber else np.sqrt(huber / e)
            _shared_jacobian(X[0] / X[2], X[1] / X[2], intrinsics, weight, J)
            c = 6 * cameras[start + k]
            V += J_point.T @ J_point
            b -= J_point.T @ r
            W[k] = J_cam.T @ J_point
            E += J.T @ J_point
            H[c : c + 6, c : c + 6] += J_cam.T @ J_cam
            H[c : c + 6, first:] += J_cam.T @ J
            H[first:, first:] += J.T @ J
            g[c : c + 6] -= J_cam.T @ r
            g[first:] -= J.T @ r
        V_inv = np.linalg.inv(V)
        H[first:, first:] -= E @ V_inv @ E.T
        g[first:] -= E @ V_inv @ b
        for k in range(num):
            c = 6 * cameras[start + k]
            Y = W[k] @ V_inv
            g[c : c + 6] -= Y @ b
            H[c : c + 6, first:] -= Y @ E.T
            for other in range(num):
                d = 6 * cameras[start + other]
                H[c : c + 6, d : d + 6] -= Y @ W[other].T
    return H, g
