"""Measure tracks again at full resolution, with patches warped by the geometry that is known.

Tracking moves a patch without deforming it. On a road or a facade that comes nearer, the flow
inside the patch is not uniform, and its mean is longer than the flow of the centre: every window
is then a little too large. Once depth and poses are roughly known, each patch can be warped
through its plane, and compared with one reference view instead of the frame before.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.backbones.classical.bundle import Bundle

MIN_CORRELATION = 0.75
MAX_SHIFT_PX = 4.0
MIN_SLANT = 0.08  # cosine between a plane's normal and the ray: below, the patch is edge-on
ITERATIONS = 8
SETTLED_PX = 0.01
# Facing the camera, lying on the ground, standing beside the road: normals in camera axes.
NORMALS = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def refine(bundle: Bundle, images: NDArray[np.float32], radius: int) -> NDArray[np.bool_]:
    """Align every observation with the patch of the point's middle view, in place.

    Args:
        bundle: adjusted points and poses; its pixels are replaced.
        images: (C, H, W) slightly blurred grey images.
        radius: half side of the patch in pixels.

    Returns:
        (M,) observations whose patch was found again.
    """
    found = np.zeros(len(bundle.cameras), bool)
    _refine_points(
        images,
        bundle.rotations,
        bundle.translations,
        bundle.points,
        bundle.cameras,
        bundle.starts,
        bundle.pixels,
        bundle.intrinsics,
        radius,
        NORMALS,
        found,
    )
    return found


@njit(cache=True, nogil=True, fastmath=True)
def _sample(image, x, y):  # type: ignore[no-untyped-def]
    """Return the bilinear value and its derivatives by x and y; NaN-free, the caller checks bounds."""
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    a, b, c, d = image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1]
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    return top + fy * (bottom - top), (1 - fy) * (b - a) + fy * (d - c), bottom - top


@njit(cache=True, nogil=True, fastmath=True)
def _template(image, x, y, radius, out):  # type: ignore[no-untyped-def]
    """Fill the zero-mean patch around (x, y); return its norm, or 0 outside the image."""
    height, width = image.shape
    if not (radius + 1 < x < width - radius - 2 and radius + 1 < y < height - radius - 2):
        return 0.0
    total, k = 0.0, 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            out[k] = _sample(image, x + dx, y + dy)[0]
            total += out[k]
            k += 1
    mean, squares = total / k, 0.0
    for i in range(k):
        out[i] -= mean
        squares += out[i] * out[i]
    return np.sqrt(squares)


@njit(cache=True, nogil=True, fastmath=True)
def _warp(x, y, radius, R, t, plane, intrinsics, out):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """Fill (K, 2) positions in the other view of the patch around (x, y); False behind it.

    ``plane`` is normal / distance in axes of the reference camera: plane @ X = 1.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    k = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            rx, ry = (x + dx - cx) / fx, (y + dy - cy) / fy
            depth = 1.0 / (plane[0] * rx + plane[1] * ry + plane[2])
            X, Y = rx * depth, ry * depth
            z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * depth + t[2]
            if depth <= 0 or z <= 0:
                return False
            out[k, 0] = fx * (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * depth + t[0]) / z + cx
            out[k, 1] = fy * (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * depth + t[1]) / z + cy
            k += 1
    return True


@njit(cache=True, nogil=True, fastmath=True)
def _align(image, template, norm, places, start, values, gradients):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """Shift the warped patch until it matches; return shift x, y and the correlation (-1: lost)."""
    height, width = image.shape
    num = template.shape[0]
    u, v = start[0], start[1]
    for _ in range(ITERATIONS):
        total = gu_mean = gv_mean = 0.0
        for k in range(num):
            x, y = places[k, 0] + u, places[k, 1] + v
            if not (0 < x < width - 2 and 0 < y < height - 2):
                return 0.0, 0.0, -1.0
            values[k], gradients[k, 0], gradients[k, 1] = _sample(image, x, y)
            total += values[k]
            gu_mean += gradients[k, 0]
            gv_mean += gradients[k, 1]
        mean, gu_mean, gv_mean = total / num, gu_mean / num, gv_mean / num
        squares = product = 0.0
        for k in range(num):
            values[k] -= mean
            squares += values[k] * values[k]
            product += values[k] * template[k]
        if squares < 1e-6:
            return 0.0, 0.0, -1.0
        gain = product / (norm * norm)  # of the view against the template
        a = b = c = p = q = 0.0
        for k in range(num):
            gu, gv = gradients[k, 0] - gu_mean, gradients[k, 1] - gv_mean
            r = gain * template[k] - values[k]
            a += gu * gu
            b += gu * gv
            c += gv * gv
            p += gu * r
            q += gv * r
        det = a * c - b * b
        if det < 1e-6 * (a + c) ** 2:
            return 0.0, 0.0, -1.0
        du, dv = (c * p - b * q) / det, (a * q - b * p) / det
        u, v = u + du, v + dv
        if abs(u) > 2 * MAX_SHIFT_PX or abs(v) > 2 * MAX_SHIFT_PX:
            return 0.0, 0.0, -1.0
        if du * du + dv * dv < SETTLED_PX * SETTLED_PX:
            break
    return u, v, product / (norm * np.sqrt(squares))


@njit(cache=True, nogil=True)
def _refine_points(  # type: ignore[no-untyped-def]  # noqa: PLR0913
    images,
    rotations,
    translations,
    points,
    cameras,
    starts,
    pixels,
    intrinsics,
    radius,
    normals,
    found,
):
    num = (2 * radius + 1) ** 2
    template, values = np.empty(num), np.empty(num)
    gradients, places = np.empty((num, 2)), np.empty((num, 2))
    no_shift = np.zeros(2)
    for point in range(points.shape[0]):
        first, last = starts[point], starts[point + 1] - 1
        middle = (first + last) // 2
        ref = cameras[middle]
        x, y = pixels[middle, 0], pixels[middle, 1]
        norm = _template(images[ref], x, y, radius, template)
        if norm < 1e-3:
            continue
        X = rotations[ref] @ points[point] + translations[ref]
        X = X[2] * np.array(
            [(x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1], 1.0]
        )
        best, best_plane = -1.0, np.zeros(3)
        for n in range(normals.shape[0]):
            slant = (normals[n] * X).sum()
            if abs(slant) < MIN_SLANT * np.sqrt((X * X).sum()):
                continue
            plane = normals[n] / slant
            score = 0.0
            for o in (first, last):
                R = rotations[cameras[o]] @ rotations[ref].T
                t = translations[cameras[o]] - R @ translations[ref]
                if _warp(x, y, radius, R, t, plane, intrinsics, places):
                    score += _align(
                        images[cameras[o]], template, norm, places, no_shift, values, gradients
                    )[2]
            if score > best:
                best, best_plane = score, plane
        if best <= 0:
            continue
        found[middle] = True
        for o in range(first, last + 1):
            if o == middle:
                continue
            R = rotations[cameras[o]] @ rotations[ref].T
            t = translations[cameras[o]] - R @ translations[ref]
            if not _warp(x, y, radius, R, t, best_plane, intrinsics, places):
                continue
            u, v, correlation = _align(
                images[cameras[o]], template, norm, places, no_shift, values, gradients
            )
            if correlation < MIN_CORRELATION or u * u + v * v > MAX_SHIFT_PX * MAX_SHIFT_PX:
                continue
            centre = num // 2
            pixels[o, 0], pixels[o, 1] = places[centre, 0] + u, places[centre, 1] + v
            found[o] = True
