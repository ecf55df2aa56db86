"""Points to pictures: z-buffered splatting on the CPU, without a display."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.types import Cloud, Image

Array = NDArray[np.float64]

_MAX_RADIUS_PX = 12.0
_SAME_SURFACE = 0.02  # of the depth: points this close behind the nearest one are mixed with it
_HOLE_ROUNDS = 3
_HOLE_NEIGHBOURS = 5  # of 8, for a pixel to be a hole and no background
_SHADE_RADIUS_PX = 2
_ROUGH = 4.0  # voxels
_STEEP_PX = 300.0  # a step of a tenth of this is shaded fully in parallel projection


@dataclass(frozen=True)
class Viewpoint:
    """A camera that looks at a cloud.

    Attributes:
        world_from_cam: (4, 4) rigid, in world units; x right, y down, z forward.
        intrinsics: (3, 3) in pixels; for parallel projection the focal lengths are pixels per
            world unit.
        size: (height, width) of the picture in pixels.
        parallel: orthographic instead of perspective.
        near: points nearer than this stay out, in world units.
    """

    world_from_cam: Array
    intrinsics: Array
    size: tuple[int, int]
    parallel: bool = False
    near: float = 0.0


def render_points(
    cloud: Cloud, viewpoint: Viewpoint, background: Image, *, shade: float = 1.0
) -> tuple[Image, NDArray[np.float32]]:
    """Draw a cloud with hidden surfaces removed.

    Every point is a disc about as large as its voxel looks from here. Discs of one surface are
    mixed, so that colours are even and edges smooth; small holes are filled from around them.
    Depth steps are shaded (eye-dome lighting), which makes shapes readable without normals.

    Args:
        cloud: the points; their voxel size gives the size of the discs.
        viewpoint: the camera.
        background: (H, W, 3) RGB, of the viewpoint's size.
        shade: strength of the shading; 0: none.

    Returns:
        (H, W, 3) RGB and the (H, W) depth, NaN where nothing was hit.
    """
    pixels = project_points(cloud.points, viewpoint)
    focal = float(viewpoint.intrinsics[0, 0])
    disc_px = 0.75 * cloud.voxel_size * focal
    depth = np.full(viewpoint.size, np.inf, np.float32)
    _draw_depth(pixels, disc_px, viewpoint.parallel, depth)
    sums = np.zeros((*viewpoint.size, 4), np.float32)
    margin = _surface_margin(cloud, viewpoint)
    _draw_color(pixels, cloud.colors, (disc_px, viewpoint.parallel, *margin), depth, sums)
    for _ in range(_HOLE_ROUNDS):
        sums, depth = _fill_holes(sums, depth)
    relief = focal / _STEEP_PX if viewpoint.parallel else 0.0
    image = _compose(sums, depth, background, (shade, relief, _ROUGH * cloud.voxel_size))
    return image, np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def project_points(points: Array, viewpoint: Viewpoint) -> NDArray[np.float32]:
    """Return (N, 3): column and row in pixels, and depth in world units; 0: behind the camera."""
    out = np.empty((len(points), 3), np.float32)
    cam_from_world = np.linalg.inv(viewpoint.world_from_cam)
    _project(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(cam_from_world[:3]),
        viewpoint.intrinsics,
        (viewpoint.parallel, viewpoint.near),
        out,
    )
    return out


def _surface_margin(cloud: Cloud, viewpoint: Viewpoint) -> tuple[float, float]:
    """Return the depth (absolute, relative) within which points belong to one surface."""
    return 2.0 * cloud.voxel_size, 0.0 if viewpoint.parallel else _SAME_SURFACE


@njit(cache=True, nogil=True)
def _project(points: Any, cam_from_world: Any, intrinsics: Any, mode: Any, out: Any) -> None:
    parallel, near = mode
    local = np.empty(3)
    for i in range(len(points)):
        for k in range(3):
            row = cam_from_world[k]
            local[k] = (
                row[0] * points[i, 0] + row[1] * points[i, 1] + row[2] * points[i, 2] + row[3]
            )
        if local[2] <= near:
            out[i, 2] = 0.0
            continue
        divisor = 1.0 if parallel else local[2]
        out[i, 0] = intrinsics[0, 0] * local[0] / divisor + intrinsics[0, 2]
        out[i, 1] = intrinsics[1, 1] * local[1] / divisor + intrinsics[1, 2]
        out[i, 2] = local[2]


@njit(cache=True, nogil=True, inline="always")
def _disc(pixel: Any, disc_px: float, parallel: bool, shape: Any) -> Any:
    """Return radius and clipped bounds (first row, past row, first column, past column)."""
    radius = disc_px if parallel else disc_px / pixel[2]
    radius = min(max(radius, 0.5), _MAX_RADIUS_PX)
    top = max(int(np.ceil(pixel[1] - radius)), 0)
    bottom = min(int(np.floor(pixel[1] + radius)) + 1, shape[0])
    left = max(int(np.ceil(pixel[0] - radius)), 0)
    right = min(int(np.floor(pixel[0] + radius)) + 1, shape[1])
    return radius, top, bottom, left, right


@njit(cache=True, nogil=True, inline="always")
def _is_seen(pixel: Any, shape: Any) -> Any:
    inside = abs(pixel[0] - 0.5 * shape[1]) < 0.5 * shape[1] + _MAX_RADIUS_PX
    return (
        pixel[2] > 0 and inside and abs(pixel[1] - 0.5 * shape[0]) < 0.5 * shape[0] + _MAX_RADIUS_PX
    )


@njit(cache=True, nogil=True)
def _draw_depth(pixels: Any, disc_px: float, parallel: bool, depth: Any) -> None:
    for i in range(len(pixels)):
        pixel = pixels[i]
        if not _is_seen(pixel, depth.shape):
            continue
        radius, top, bottom, left, right = _disc(pixel, disc_px, parallel, depth.shape)
        for v in range(top, bottom):
            for u in range(left, right):
                inside = (u - pixel[0]) ** 2 + (v - pixel[1]) ** 2 <= radius * radius + 0.25
                if inside and pixel[2] < depth[v, u]:
                    depth[v, u] = pixel[2]


@njit(cache=True, nogil=True)
def _draw_color(pixels: Any, colors: Any, mode: Any, depth: Any, sums: Any) -> None:
    disc_px, parallel, absolute, relative = mode
    for i in range(len(pixels)):
        pixel = pixels[i]
        if not _is_seen(pixel, depth.shape):
            continue
        radius, top, bottom, left, right = _disc(pixel, disc_px, parallel, depth.shape)
        front = pixel[2] - absolute - relative * pixel[2]
        for v in range(top, bottom):
            for u in range(left, right):
                distance2 = (u - pixel[0]) ** 2 + (v - pixel[1]) ** 2
                reach = radius * radius + 0.25
                if distance2 > reach or depth[v, u] < front:
                    continue
                weight = 1.02 - distance2 / reach
                for k in range(3):
                    sums[v, u, k] += weight * colors[i, k]
                sums[v, u, 3] += weight


@njit(cache=True, nogil=True)
def _fill_holes(sums: Any, depth: Any) -> Any:
    """Give pixels that are mostly surrounded the mean of their neighbours."""
    height, width = depth.shape
    new_sums, new_depth = sums.copy(), depth.copy()
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            if sums[v, u, 3] == 0 and _count_neighbours(sums, v, u) >= _HOLE_NEIGHBOURS:
                new_depth[v, u] = _mean_around(sums, depth, (v, u), new_sums[v, u])
    return new_sums, new_depth


@njit(cache=True, nogil=True, inline="always")
def _count_neighbours(sums: Any, v: int, u: int) -> int:
    count = 0
    for row in range(v - 1, v + 2):
        for column in range(u - 1, u + 2):
            count += sums[row, column, 3] > 0
    return count


@njit(cache=True, nogil=True)
def _mean_around(sums: Any, depth: Any, pixel: Any, mean: Any) -> Any:
    """Add the colours of the neighbours to ``mean``; return their mean depth."""
    v, u = pixel
    total_depth = 0.0
    for row in range(v - 1, v + 2):
        for column in range(u - 1, u + 2):
            weight = sums[row, column, 3]
            if weight > 0:
                for k in range(3):
                    mean[k] += sums[row, column, k] / weight
                mean[3] += 1
                total_depth += depth[row, column]
    return total_depth / mean[3]


@njit(cache=True, nogil=True)
def _compose(sums: Any, depth: Any, background: Any, light: Any) -> Any:
    shade, relief, rough = light
    height, width = depth.shape
    image = background.copy()
    for v in range(height):
        for u in range(width):
            total = sums[v, u, 3]
            if total <= 0:
                continue
            gain = np.exp(-shade * _occlusion(depth, (v, u), relief, rough)) / total
            for k in range(3):
                image[v, u, k] = np.uint8(min(gain * sums[v, u, k] + 0.5, 255.0))
    return image


@njit(cache=True, nogil=True, inline="always")
def _occlusion(depth: Any, pixel: Any, relief: float, rough: float) -> float:
    """Return how much nearer the surroundings are, in [0, 1] (eye-dome lighting).

    A step counts relative to the depth, or in parallel projection times ``relief``, as far as it
    is larger than ``rough``: the discs themselves must not show.
    """
    v, u = pixel
    scale = relief if relief > 0 else 1.0 / depth[v, u]
    total = 0.0
    for dv in range(-1, 2):
        for du in range(-1, 2):
            row, column = v + _SHADE_RADIUS_PX * dv, u + _SHADE_RADIUS_PX * du
            if 0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]:
                step = scale * (depth[v, u] - depth[row, column] - rough)
                total += min(max(step, 0.0), 0.1) / 0.1
    return total / 8.0
