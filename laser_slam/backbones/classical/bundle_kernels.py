"""Compiled parts of bundle adjustment.

They take plain arrays, so that numba compiles them once and they run without the GIL. Shared
arguments: rotations (C, 3, 3) and translations (C, 3) cam_from_window, points (P, 3), cameras (M,)
and pixels (M, 2) of the observations, sorted by point, starts (P + 1,) first observation of each
point, intrinsics (8,) fx, fy, cx, cy, k1, k2, p1, p2.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from laser_slam.backbones.classical.compiled import finite_kernel

MIN_DEPTH = 1e-6
BEHIND_COST = 1e6  # of an observation behind its camera: no solution
TRIALS = 6  # of larger and larger damping in one iteration
SETTLED = 1e-5  # relative fall of the cost at which it stops


@njit(cache=True, nogil=True)
def distorted(x, y, intrinsics):
    """Return the pixel of a ray (x, y, 1), bent by k1, k2, p1, p2 as OpenCV defines them."""
    k1, k2, p1, p2 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    u = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = radial * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return intrinsics[0] * u + intrinsics[2], intrinsics[1] * v + intrinsics[3]


@njit(cache=True, nogil=True)
def residual_norms(rotations, translations, points, cameras, starts, pixels, intrinsics, out):
    """Fill (M,) lengths of the residuals in pixels; infinite behind the camera."""
    for point in range(points.shape[0]):
        for o in range(starts[point], starts[point + 1]):
            c = cameras[o]
            x = rotations[c] @ points[point] + translations[c]
            if x[2] <= MIN_DEPTH:
                out[o] = np.inf
                continue
            u, v = distorted(x[0] / x[2], x[1] / x[2], intrinsics)
            out[o] = np.sqrt((u - pixels[o, 0]) ** 2 + (v - pixels[o, 1]) ** 2)


@njit(cache=True, nogil=True)
def _cost(rotations, translations, points, cameras, starts, pixels, intrinsics, huber):
    total = 0.0
    for point in range(points.shape[0]):
        px, py, pz = points[point]
        for o in range(starts[point], starts[point + 1]):
            R, t = rotations[cameras[o]], translations[cameras[o]]
            z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
            if z <= MIN_DEPTH:
                total += BEHIND_COST
                continue
            x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
            y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
            u, v = distorted(x / z, y / z, intrinsics)
            e = np.sqrt((u - pixels[o, 0]) ** 2 + (v - pixels[o, 1]) ** 2)
            total += e * e if e <= huber else 2 * huber * e - huber * huber
    return total


@njit(cache=True, nogil=True)
def linearise(R, t, point, pixel, intrinsics, huber, J_cam, J_point, residual):
    """Fill the weighted Jacobians and residual of one observation.

    The pose moves as ``exp(w) R x + t + d``: derivatives by w (3), then d (3). Behind the camera
    all are zero.
    """
    rx = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2]
    ry = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2]
    rz = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2]
    x, y, z = rx + t[0], ry + t[1], rz + t[2]
    if z <= MIN_DEPTH:
        J_cam[:], J_point[:], residual[:] = 0.0, 0.0, 0.0
        return
    xn, yn = x / z, y / z
    u, v = distorted(xn, yn, intrinsics)
    du, dv = u - pixel[0], v - pixel[1]
    e = np.sqrt(du * du + dv * dv)
    w = 1.0 if e <= huber else np.sqrt(huber / e)
    residual[0], residual[1] = w * du, w * dv
    r2 = xn * xn + yn * yn
    radial = 1 + r2 * (intrinsics[4] + r2 * intrinsics[5])
    slope = intrinsics[4] + 2 * r2 * intrinsics[5]  # of the radial factor over r2
    p1, p2 = intrinsics[6], intrinsics[7]
    fx, fy = w * intrinsics[0] / z, w * intrinsics[1] / z
    mixed = 2 * (slope * xn * yn + p1 * xn + p2 * yn)
    ux, uy = fx * (radial + 2 * slope * xn * xn + 2 * p1 * yn + 6 * p2 * xn), fx * mixed
    vx, vy = fy * mixed, fy * (radial + 2 * slope * yn * yn + 6 * p1 * yn + 2 * p2 * xn)
    uz, vz = -(ux * xn + uy * yn), -(vx * xn + vy * yn)
    for i, (gx, gy, gz) in enumerate(((ux, uy, uz), (vx, vy, vz))):
        J_cam[i, 0], J_cam[i, 1] = gz * ry - gy * rz, gx * rz - gz * rx
        J_cam[i, 2] = gy * rx - gx * ry
        J_cam[i, 3], J_cam[i, 4], J_cam[i, 5] = gx, gy, gz
        for k in range(3):
            J_point[i, k] = gx * R[0, k] + gy * R[1, k] + gz * R[2, k]


@njit(cache=True, nogil=True)
def _invert3(a, damping, out):
    """Invert a symmetric positive (3, 3) matrix whose diagonal is raised by the damping."""
    d0 = a[0, 0] * (1 + damping) + 1e-12
    d1 = a[1, 1] * (1 + damping) + 1e-12
    d2 = a[2, 2] * (1 + damping) + 1e-12
    c00, c01 = d1 * d2 - a[1, 2] ** 2, a[0, 2] * a[1, 2] - a[0, 1] * d2
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * d1
    det = d0 * c00 + a[0, 1] * c01 + a[0, 2] * c02
    if not det > 0:  # its rays are parallel: the point stays where it is
        out[:] = 0.0
        return
    inv = 1.0 / det
    out[0, 0], out[1, 1] = c00 * inv, (d0 * d2 - a[0, 2] ** 2) * inv
    out[2, 2] = (d0 * d1 - a[0, 1] ** 2) * inv
    out[0, 1] = out[1, 0] = c01 * inv
    out[0, 2] = out[2, 0] = c02 * inv
    out[1, 2] = out[2, 1] = (a[0, 1] * a[0, 2] - d0 * a[1, 2]) * inv


@njit(cache=True, nogil=True)
def normal_equations(
    rotations, translations, points, cameras, starts, pixels, intrinsics, huber, H, g, W, V, b
):
    """Add up the cameras' H (6C, 6C), g (6C,), the points' V (P, 3, 3), b (P, 3), and fill W.

    W (M, 6, 3) holds the cross blocks, one for each observation.
    """
    J_cam, J_point, r = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros(2)
    for point in range(points.shape[0]):
        for o in range(starts[point], starts[point + 1]):
            c = cameras[o]
            R, t = rotations[c], translations[c]
            linearise(R, t, points[point], pixels[o], intrinsics, huber, J_cam, J_point, r)
            for i in range(3):
                b[point, i] -= J_point[0, i] * r[0] + J_point[1, i] * r[1]
                for j in range(3):
                    V[point, i, j] += J_point[0, i] * J_point[0, j] + J_point[1, i] * J_point[1, j]
            for i in range(6):
                g[6 * c + i] -= J_cam[0, i] * r[0] + J_cam[1, i] * r[1]
                for j in range(6):
                    H[6 * c + i, 6 * c + j] += J_cam[0, i] * J_cam[0, j] + J_cam[1, i] * J_cam[1, j]
                for j in range(3):
                    W[o, i, j] = J_cam[0, i] * J_point[0, j] + J_cam[1, i] * J_point[1, j]


@finite_kernel
def eliminate_points(cameras, starts, W, V, b, damping, S, s, V_inv):
    """Subtract the points' part: S -= W V^-1 W^T, s -= W V^-1 b (lower blocks only)."""
    Y = np.zeros((6, 3))
    for point in range(V.shape[0]):
        _invert3(V[point], damping, V_inv[point])
        for o in range(starts[point], starts[point + 1]):
            c = 6 * cameras[o]
            for i in range(6):
                for j in range(3):
                    Y[i, j] = (
                        W[o, i, 0] * V_inv[point, 0, j]
                        + W[o, i, 1] * V_inv[point, 1, j]
                        + W[o, i, 2] * V_inv[point, 2, j]
                    )
                s[c + i] -= Y[i, 0] * b[point, 0] + Y[i, 1] * b[point, 1] + Y[i, 2] * b[point, 2]
            for p in range(starts[point], starts[point + 1]):
                d = 6 * cameras[p]
                if d > c:
                    continue
                for i in range(6):
                    for j in range(6):
                        S[c + i, d + j] -= (
                            Y[i, 0] * W[p, j, 0] + Y[i, 1] * W[p, j, 1] + Y[i, 2] * W[p, j, 2]
                        )


@finite_kernel
def _solve_cholesky(S, s):
    """Solve S x = s in place from the lower triangle; False when S is not positive."""
    n = S.shape[0]
    for i in range(n):
        for j in range(i + 1):
            acc = S[i, j]
            for k in range(j):
                acc -= S[i, k] * S[j, k]
            if i == j:
                if not acc > 0:
                    return False
                S[i, i] = np.sqrt(acc)
            else:
                S[i, j] = acc / S[j, j]
    for i in range(n):
        for k in range(i):
            s[i] -= S[i, k] * s[k]
        s[i] /= S[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            s[i] -= S[k, i] * s[k]
        s[i] /= S[i, i]
    return True


@njit(cache=True, nogil=True)
def _rotate(w, R):
    """Return exp(w) R."""
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    a = 1.0 - angle**2 / 6 if angle < 1e-4 else np.sin(angle) / angle
    b = 0.5 - angle**2 / 24 if angle < 1e-4 else (1 - np.cos(angle)) / angle**2
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return (np.eye(3) + a * K + b * (K @ K)) @ R


@njit(cache=True, nogil=True)
def _move(rotations, translations, points, step, starts, cameras, W, V_inv, b):
    """Return poses and points after a camera step (6C), points by back-substitution."""
    new_R, new_t, new_points = rotations.copy(), translations.copy(), points.copy()
    for c in range(rotations.shape[0]):
        new_R[c] = _rotate(step[6 * c : 6 * c + 3], rotations[c])
        new_t[c] += step[6 * c + 3 : 6 * c + 6]
    for point in range(points.shape[0]):
        rest = b[point].copy()
        for o in range(starts[point], starts[point + 1]):
            for i in range(6):
                rest -= W[o, i] * step[6 * cameras[o] + i]
        new_points[point] += V_inv[point] @ rest
    return new_R, new_t, new_points


@njit(cache=True, nogil=True)
def _camera_step(H, g, W, V, b, cameras, starts, is_fixed, damping):
    """Return whether the damped equations could be solved, the (6C,) step, and V^-1."""
    S, s, V_inv = H.copy(), g.copy(), np.zeros_like(V)
    eliminate_points(cameras, starts, W, V, b, damping, S, s, V_inv)
    for i in range(S.shape[0]):
        S[i, i] += damping * H[i, i] + 1e-9
        if is_fixed[i // 6]:
            S[i, :] = 0.0
            S[:, i] = 0.0
            S[i, i] = 1.0
            s[i] = 0.0
    return _solve_cholesky(S, s), s, V_inv


@njit(cache=True, nogil=True)
def levenberg_marquardt(
    rotations,
    translations,
    points,
    cameras,
    starts,
    pixels,
    is_fixed,
    intrinsics,
    huber,
    iterations,
):
    """Minimise the Huber cost, poses and points in place; return the cost, which never rises."""
    num_cams = rotations.shape[0]
    damping = 1e-4
    cost = _cost(rotations, translations, points, cameras, starts, pixels, intrinsics, huber)
    for _iteration in range(iterations):
        H, g = np.zeros((6 * num_cams, 6 * num_cams)), np.zeros(6 * num_cams)
        W = np.zeros((cameras.shape[0], 6, 3))
        V, b = np.zeros((points.shape[0], 3, 3)), np.zeros((points.shape[0], 3))
        normal_equations(
            rotations,
            translations,
            points,
            cameras,
            starts,
            pixels,
            intrinsics,
            huber,
            H,
            g,
            W,
            V,
            b,
        )
        improved = False
        for _ in range(TRIALS):
            is_solved, step, V_inv = _camera_step(H, g, W, V, b, cameras, starts, is_fixed, damping)
            if is_solved:
                new_R, new_t, new_points = _move(
                    rotations, translations, points, step, starts, cameras, W, V_inv, b
                )
                new_cost = _cost(
                    new_R, new_t, new_points, cameras, starts, pixels, intrinsics, huber
                )
                if new_cost < cost:
                    improved = True
                    break
            damping *= 10
        if not improved:
            break
        rotations[:], translations[:], points[:] = new_R, new_t, new_points
        settled = cost - new_cost < SETTLED * cost
        cost, damping = new_cost, max(damping / 10, 1e-10)
        if settled:
            break
    return cost
