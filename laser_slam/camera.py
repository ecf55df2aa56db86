"""The pinhole camera: x right, y down, z forward; pixel centres at integer coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMMON_FOCAL = 0.6  # image widths: 80 degrees, between a telephone and a dashcam


def intrinsics_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return the (3, 3) intrinsics in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def intrinsics_from_fov(fov_deg: float, height: int, width: int) -> Array:
    """Return intrinsics with square pixels and the principal point in the image's centre.

    Args:
        fov_deg: horizontal field of view in degrees.
        height: image height in pixels.
        width: image width in pixels.

    >>> float(intrinsics_from_fov(90.0, 100, 200)[0, 0].round(6))
    100.0
    """
    focal = 0.5 * width / np.tan(0.5 * np.radians(fov_deg))
    return intrinsics_matrix(
        round(float(focal), 9), round(float(focal), 9), (width - 1) / 2, (height - 1) / 2
    )


def guess_intrinsics(height: int, width: int, relative_focal: float = COMMON_FOCAL) -> Array:
    """Return the intrinsics of a common camera, for images of which nothing is known.

    Args:
        height: image height in pixels.
        width: image width in pixels.
        relative_focal: focal length in image widths, where that is known.
    """
    focal = relative_focal * width
    return intrinsics_matrix(focal, focal, (width - 1) / 2, (height - 1) / 2)


def resize_intrinsics(intrinsics: Array, size: tuple[int, int], new_size: tuple[int, int]) -> Array:
    """Scale (..., 3, 3) intrinsics of a (height, width) image to another size, per axis.

    Pixel centres are at integers, so the image spans -0.5 to width - 0.5.
    """
    fy, fx = new_size[0] / size[0], new_size[1] / size[1]
    out = np.array(intrinsics, dtype=np.float64)
    out[..., 0, :2] *= fx
    out[..., 1, 1] *= fy
    out[..., 0, 2] = (intrinsics[..., 0, 2] + 0.5) * fx - 0.5
    out[..., 1, 2] = (intrinsics[..., 1, 2] + 0.5) * fy - 0.5
    return out


def rays(intrinsics: Array, height: int, width: int) -> Array:
    """Return (height, width, 3) directions of the pixels in camera axes, with z = 1."""
    x = (np.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (np.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1]
    out = np.ones((height, width, 3))
    out[..., 0] = x
    out[..., 1] = y[:, None]
    return out


def unproject(depth: NDArray[np.float32], intrinsics: Array) -> Array:
    """Return (H, W, 3) points in camera axes of a (H, W) depth map; NaN where depth is unknown."""
    height, width = depth.shape
    return rays(intrinsics, height, width) * depth[..., None].astype(np.float64)


def project(points: Array, intrinsics: Array) -> Array:
    """Project (..., 3) points in camera axes to (..., 2) pixels; NaN at or behind the camera."""
    z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    u = intrinsics[0, 0] * points[..., 0] / z + intrinsics[0, 2]
    v = intrinsics[1, 1] * points[..., 1] / z + intrinsics[1, 2]
    return np.stack([u, v], axis=-1)


def distort(slopes: Array, distortion: Array) -> Array:
    """Bend rays as a lens does.

    Args:
        slopes: (..., 2) x / z and y / z.
        distortion: (4,) radial k1, k2 and tangential p1, p2 as OpenCV defines them.
    """
    k1, k2, p1, p2 = distortion
    x, y = slopes[..., 0], slopes[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    bent_x = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = radial * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([bent_x, bent_y], axis=-1)


def poselib_camera(intrinsics: Array) -> dict[str, object]:
    """Describe a pinhole camera as poselib wants it.

    It applies the parameters as they are, so pixel centres stay where ours are: at integers. Width
    and height must be there, and nothing reads them.
    """
    params = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
    return {"model": "PINHOLE", "width": 0, "height": 0, "params": params}


def median_depth(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], min_confidence: float
) -> float | None:
    """Return the median depth of a window's confident pixels; None: there are none.

    Args:
        depth: (N, H, W) in any unit; every second row and column is looked at.
        confidence: (N, H, W) in [0, 1].
        min_confidence: that a pixel needs.
    """
    depth, confidence = depth[:, ::2, ::2], confidence[:, ::2, ::2]
    known = depth[(confidence >= min_confidence) & (depth > 0) & np.isfinite(depth)]
    return float(np.median(known)) if known.size else None
