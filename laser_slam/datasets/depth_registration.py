"""Depth as another camera beside the depth camera sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import project, rays

Array = NDArray[np.float64]
Depth = NDArray[np.float32]


def register_depth(
    depth: Depth, depth_intrinsics: Array, intrinsics: Array, cam_from_depth_cam: Array
) -> Depth:
    """Carry each pixel's point to its nearest pixel of the other camera; the nearest one hides.

    Pixels that nothing falls on stay unknown, such as those beside an edge in front.

    Args:
        depth: (H, W) z in metres; NaN: unknown.
        depth_intrinsics: (3, 3) of the camera that measured it.
        intrinsics: (3, 3) of the other camera, whose images have the same size.
        cam_from_depth_cam: (4, 4) rigid, metres.

    Returns:
        (H, W) z in metres of the other camera; NaN: unknown.
    """
    known = np.isfinite(depth)
    points = rays(depth_intrinsics, *depth.shape)[known] * depth[known].astype(np.float64)[:, None]
    points = points @ cam_from_depth_cam[:3, :3].T + cam_from_depth_cam[:3, 3]
    seen = nearest_depth(points, intrinsics, (depth.shape[0], depth.shape[1]))
    return np.where(np.isfinite(seen), seen, np.float32(np.nan))


def nearest_depth(points: Array, intrinsics: Array, size: tuple[int, int]) -> Depth:
    """Let each point fall into its nearest pixel; of several in one pixel the nearest stays.

    Args:
        points: (N, 3) in metres, in the camera's axes.
        intrinsics: (3, 3) of the camera.
        size: (height, width) of its images.

    Returns:
        (height, width) z in metres; infinite: nothing fell there.
    """
    points = points[points[:, 2] > 0]
    columns, rows = _nearest(project(points, intrinsics).clip(-1e6, 1e6)).T
    height, width = size
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    nearest = np.full(size, np.inf, np.float32)
    np.minimum.at(nearest, (rows[inside], columns[inside]), points[inside, 2].astype(np.float32))
    return nearest


def look_up_depth(
    depth: Depth, depth_intrinsics: Array, intrinsics: Array, size: tuple[int, int]
) -> Depth:
    """Give each pixel of another camera at the same place the nearest depth in its direction.

    Args:
        depth: (H, W) z in metres; NaN: unknown.
        depth_intrinsics: (3, 3) of the camera that measured it.
        intrinsics: (3, 3) of the other camera.
        size: (height, width) of the other camera's images.

    Returns:
        (height, width) z in metres; NaN: unknown, or beyond the edge of ``depth``.
    """
    seen = rays(intrinsics, *size)
    columns = _nearest(seen[0, :, 0] * depth_intrinsics[0, 0] + depth_intrinsics[0, 2])
    rows = _nearest(seen[:, 0, 1] * depth_intrinsics[1, 1] + depth_intrinsics[1, 2])
    framed = np.pad(depth, 1, constant_values=np.nan)
    height, width = framed.shape
    return np.asarray(
        framed[np.ix_((rows + 1).clip(0, height - 1), (columns + 1).clip(0, width - 1))]
    )


def _nearest(places: Array) -> NDArray[np.int64]:
    return np.asarray(np.rint(places), np.int64)
