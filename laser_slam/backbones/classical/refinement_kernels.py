"""Compiled part of the refinement: patches warped through planes and aligned."""

from __future__ import annotations

import numpy as np
from numba import njit

from laser_slam.backbones.classical.compiled import finite_kernel

MIN_CORRELATION = 0.75
MAX_SHIFT_PX = 4.0
MIN_SLANT = 0.08  # cosine between a plane's normal and the ray: below, the patch is edge-on
ITERATIONS = 8
SETTLED_PX = 0.01


@finite_kernel
def _sample(image, x, y):
    """Return the bilinear value and its derivatives by x and y; the caller checks the bounds."""
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    a, b, c, d = image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1]
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    return top + fy * (bottom - top), (1 - fy) * (b - a) + fy * (d - c), bottom - top


@finite_kernel
def _template(image, x, y, radius, out):
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


@finite_kernel
def _warp(x, y, radius, R, t, plane, intrinsics, out):
    """Fill (K, 2) positions in the other view of the patch around (x, y); False behind it.

    ``plane`` is normal / distance in axes of the reference camera: plane @ X = 1.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    k = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            rx, ry = (x + dx - cx) / fx, (y + dy - cy) / fy
            inverse_depth = plane[0] * rx + plane[1] * ry + plane[2]
            if inverse_depth <= 0:  # the plane's horizon
                return False
            depth = 1.0 / inverse_depth
            X, Y = rx * depth, ry * depth
            z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * depth + t[2]
            if z <= 0:
                return False
            out[k, 0] = fx * (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * depth + t[0]) / z + cx
            out[k, 1] = fy * (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * depth + t[1]) / z + cy
            k += 1
    return True


@finite_kernel
def _align(image, template, norm, places, start, values, gradients):
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
        if det <= 1e-6 * (a + c) ** 2:
            return 0.0, 0.0, -1.0
        du, dv = (c * p - b * q) / det, (a * q - b * p) / det
        u, v = u + du, v + dv
        if abs(u) > 2 * MAX_SHIFT_PX or abs(v) > 2 * MAX_SHIFT_PX:
            return 0.0, 0.0, -1.0
        if du * du + dv * dv < SETTLED_PX * SETTLED_PX:
            break
    return u, v, product / (norm * np.sqrt(squares))


@njit(cache=True, nogil=True)
def _relative(rotations, translations, camera, reference):
    """Return camera_from_reference: rotation and translation."""
    R = rotations[camera] @ rotations[reference].T
    return R, translations[camera] - R @ translations[reference]


@njit(cache=True, nogil=True)
def _choose_plane(
    images,
    rotations,
    translations,
    cameras,
    ends,
    ref,
    X,
    x,
    y,
    template,
    norm,
    intrinsics,
    normals,
):
    """Return the plane through X that the track's two ends agree with best; all zero: none.

    X is the point in axes of the reference camera ``ref``, (x, y) its pixel there; ``ends`` are the
    first and the last observation; a plane is normal / distance, as `_warp` wants it.
    """
    num = template.shape[0]
    values, gradients, places = np.empty(num), np.empty((num, 2)), np.empty((num, 2))
    radius, no_shift = int(np.sqrt(num)) // 2, np.zeros(2)
    best, best_plane = 0.0, np.zeros(3)
    for n in range(normals.shape[0]):
        slant = (normals[n] * X).sum()
        if abs(slant) < MIN_SLANT * np.sqrt((X * X).sum()):
            continue
        plane, score = normals[n] / slant, 0.0
        for o in ends:
            R, t = _relative(rotations, translations, cameras[o], ref)
            if _warp(x, y, radius, R, t, plane, intrinsics, places):
                image = images[cameras[o]]
                score += _align(image, template, norm, places, no_shift, values, gradients)[2]
        if score > best:
            best, best_plane = score, plane
    return best_plane


@njit(cache=True, nogil=True)
def refine_points(
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
    """Measure pixels (M, 2) again, in place; set ``found`` (M,) where that worked.

    images (C, H, W), radius of the patches, normals (N, 3) of the planes to try in camera axes, the
    other arguments as in `bundle_kernels`. The view of a track's middle is the reference.
    """
    num = (2 * radius + 1) ** 2
    template, values = np.empty(num), np.empty(num)
    gradients, places = np.empty((num, 2)), np.empty((num, 2))
    no_shift = np.zeros(2)
    for point in range(points.shape[0]):
        first, last = starts[point], starts[point + 1] - 1
        middle = (first + last) // 2
        ref, x, y = cameras[middle], pixels[middle, 0], pixels[middle, 1]
        norm = _template(images[ref], x, y, radius, template)
        z = (rotations[ref] @ points[point] + translations[ref])[2]
        if norm < 1e-3 or not z > 0:
            continue
        ray = ((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1], 1.0)
        X = z * np.array(ray)
        ends = (first, last)
        plane = _choose_plane(
            images,
            rotations,
            translations,
            cameras,
            ends,
            ref,
            X,
            x,
            y,
            template,
            norm,
            intrinsics,
            normals,
        )
        if not plane.any():
            continue
        found[middle] = True
        for o in range(first, last + 1):
            R, t = _relative(rotations, translations, cameras[o], ref)
            if o == middle or not _warp(x, y, radius, R, t, plane, intrinsics, places):
                continue
            u, v, correlation = _align(
                images[cameras[o]], template, norm, places, no_shift, values, gradients
            )
            if correlation >= MIN_CORRELATION and u * u + v * v <= MAX_SHIFT_PX * MAX_SHIFT_PX:
                pixels[o, 0], pixels[o, 1] = places[num // 2, 0] + u, places[num // 2, 1] + v
                found[o] = True
