"""Which pixels of a submap go into the map, and where they lie."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.camera import median_depth
from laser_slam.config import FusionConfig
from laser_slam.fusion.consistency import consistent_depth
from laser_slam.fusion.edges import drop_edges
from laser_slam.types import Submap

Array = NDArray[np.float64]

_REACH = 3  # pixels to each side that a normal is taken from: less noise than at the next ones


class View(NamedTuple):
    """One frame as the kernels want it.

    Attributes:
        depth: (H, W) in window units.
        weight: (H, W) confidence; 0: stays out.
        color: (H, W, 3) RGB.
        world_from_ray: (3, 3) maps (u, v, 1) times depth to world axes and units.
        center: (3,) the camera in world units.
    """

    depth: NDArray[np.float32]
    weight: NDArray[np.float32]
    color: NDArray[np.uint8]
    world_from_ray: Array
    center: Array


def _median_depth(submap: Submap, config: FusionConfig) -> float | None:
    prediction = submap.prediction
    return median_depth(prediction.depth, prediction.confidence, config.min_confidence)


def automatic_voxel_size(submap: Submap, config: FusionConfig) -> float | None:
    """Return the edge of the voxels in world units that suits a submap; None: it has no depth.

    It is no shorter than the gap between used pixels at the median depth: else the views that a
    voxel needs would seldom meet in it, and little of the map would stay.
    """
    median = _median_depth(submap, config)
    if median is None:
        return None
    gap = config.stride / float(np.median(submap.prediction.intrinsics[:, 0, 0]))
    return max(config.auto_voxel, gap) * median * submap.world_from_window.scale


def owned_views(submap: Submap, config: FusionConfig) -> Iterator[View]:
    """Give the frames that a submap owns, without the pixels that would harm the map."""
    prediction, median = submap.prediction, _median_depth(submap, config)
    if median is None:
        return
    for i in np.flatnonzero(submap.is_owned):
        depth, confidence = prediction.depth[i], prediction.confidence[i]
        near = (depth > 0) & (depth <= config.max_range * median)
        usable = near & (confidence >= config.min_confidence)
        place = submap.places[i] if submap.places else submap.world_from_window
        world_from_cam = place.apply_poses(prediction.window_from_cam[i])
        cam_from_pixel = np.linalg.inv(prediction.intrinsics[i])
        weight = np.where(usable, confidence, 0).astype(np.float32)
        drop_edges(np.ascontiguousarray(depth, np.float32), config.edge_jump, weight)
        yield View(
            depth=consistent_depth(prediction, int(i), weight, config),
            weight=weight,
            color=np.ascontiguousarray(submap.colors[i]),
            world_from_ray=np.ascontiguousarray(
                place.scale * world_from_cam[:3, :3] @ cam_from_pixel
            ),
            center=world_from_cam[:3, 3].copy(),
        )


@njit(cache=True, nogil=True, inline="always")
def surface_normal(view: Any, v: int, u: int) -> Any:
    """Return the unit normal of the surface at a pixel, in world axes, towards the camera.

    It is square to the lines between the pixels ``_REACH`` before and after, across and down.
    Where one of them is not used, the pixel itself takes its place; where both: the ray does.
    """
    across = _line(view, v, u, 0, _REACH)
    down = _line(view, v, u, _REACH, 0)
    nx = across[1] * down[2] - across[2] * down[1]
    ny = across[2] * down[0] - across[0] * down[2]
    nz = across[0] * down[1] - across[1] * down[0]
    ray = _ray(view, v, u)
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if not length > 0:
        nx, ny, nz = ray
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if nx * ray[0] + ny * ray[1] + nz * ray[2] > 0:
        length = -length
    return nx / length, ny / length, nz / length


@njit(cache=True, nogil=True, inline="always")
def _ray(view: Any, v: int, u: int) -> Any:
    m = view.world_from_ray
    return (
        m[0, 0] * u + m[0, 1] * v + m[0, 2],
        m[1, 0] * u + m[1, 1] * v + m[1, 2],
        m[2, 0] * u + m[2, 1] * v + m[2, 2],
    )


@njit(cache=True, nogil=True, inline="always")
def _line(view: Any, v: int, u: int, down: int, across: int) -> Any:
    """Return the vector from a pixel before to a pixel after, as far as they are used."""
    height, width = view.depth.shape
    v0, u0, v1, u1 = v - down, u - across, v + down, u + across
    if v0 < 0 or u0 < 0 or not view.weight[v0, u0] > 0:
        v0, u0 = v, u
    if v1 >= height or u1 >= width or not view.weight[v1, u1] > 0:
        v1, u1 = v, u
    first, last = _ray(view, v0, u0), _ray(view, v1, u1)
    d0, d1 = np.float64(view.depth[v0, u0]), np.float64(view.depth[v1, u1])
    return (
        d1 * last[0] - d0 * first[0],
        d1 * last[1] - d0 * first[1],
        d1 * last[2] - d0 * first[2],
    )
