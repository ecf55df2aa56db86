"""Submaps to one coloured cloud: a voxel-hashed average whose memory grows with the map alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numba import njit

from laser_slam.config import FusionConfig
from laser_slam.fusion.grid import View, VoxelGrid
from laser_slam.types import Cloud, Submap


def fuse(submaps: Iterable[Submap], config: FusionConfig) -> Cloud:
    """Average the confident pixels of all owned frames in voxels, each weighted by confidence.

    Submaps are taken one after the other and none is kept: memory grows with the voxels
    (about 60 bytes each), not with the pixels. Every frame counts once, in the window that owns
    it. Pixels at depth edges stay out, because depth maps blend both sides there and would
    leave veils of points behind every object.

    Args:
        submaps: in any order; those without depth add nothing.
        config: thresholds; an automatic voxel size follows the first submap with depth.

    Returns:
        The cloud in world units; empty when no pixel was confident.
    """
    grid: VoxelGrid | None = None
    for submap in submaps:
        median = _median_depth(submap, config)
        if median is None:
            continue
        if grid is None:
            automatic = config.auto_voxel * median * submap.world_from_window.scale
            grid = VoxelGrid(config.voxel_size or automatic)
        for view in _owned_views(submap, median, config):
            _drop_edges(view.depth, config.edge_jump, view.weight)
            grid.add(view, config.stride)
    return VoxelGrid(1.0).cloud(1) if grid is None else grid.cloud(config.min_observations)


def _median_depth(submap: Submap, config: FusionConfig) -> float | None:
    """Return the median depth of the window's confident pixels; None: there are none."""
    prediction = submap.prediction
    depth = prediction.depth[:, ::2, ::2]
    confidence = prediction.confidence[:, ::2, ::2]
    known = depth[(confidence >= config.min_confidence) & (depth > 0) & np.isfinite(depth)]
    return float(np.median(known)) if known.size else None


def _owned_views(submap: Submap, median: float, config: FusionConfig) -> Iterator[View]:
    prediction = submap.prediction
    for i in np.flatnonzero(submap.is_owned):
        depth, confidence = prediction.depth[i], prediction.confidence[i]
        near = (depth > 0) & (depth <= config.max_range * median)
        usable = near & (confidence >= config.min_confidence)
        place = submap.places[i] if submap.places else submap.world_from_window
        world_from_cam = place.apply_poses(prediction.window_from_cam[i])
        cam_from_pixel = np.linalg.inv(prediction.intrinsics[i])
        yield View(
            depth=np.ascontiguousarray(depth, np.float32),
            weight=np.where(usable, confidence, 0).astype(np.float32),
            color=np.ascontiguousarray(submap.colors[i]),
            world_from_ray=place.scale * world_from_cam[:3, :3] @ cam_from_pixel,
            center=world_from_cam[:3, 3].copy(),
        )


@njit(cache=True, nogil=True)
def _drop_edges(depth: Any, max_jump: float, weight: Any) -> None:
    """Set the weight of both pixels to 0 wherever depth jumps between neighbours.

    A step of more than ``max_jump`` of the nearer depth is a jump, unless the pixels before and
    after continue it as a plane would (inverse depth is linear on a plane): a road seen at a
    grazing angle stays. A step of three times as much is always a jump.
    """
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            if u + 1 < width and _jumps(depth, v, u, (0, 1), max_jump):
                weight[v, u] = weight[v, u + 1] = 0.0
            if v + 1 < height and _jumps(depth, v, u, (1, 0), max_jump):
                weight[v, u] = weight[v + 1, u] = 0.0


@njit(cache=True, nogil=True, inline="always")
def _jumps(depth: Any, v: int, u: int, step: Any, max_jump: float) -> bool:
    here, there = depth[v, u], depth[v + step[0], u + step[1]]
    jump = abs(here - there) / min(here, there)
    if not jump > max_jump:  # also where depth is unknown
        return False
    if jump > 3 * max_jump:
        return True
    v_before, u_before = v - step[0], u - step[1]
    v_after, u_after = v + 2 * step[0], u + 2 * step[1]
    if v_before < 0 or u_before < 0 or v_after >= depth.shape[0] or u_after >= depth.shape[1]:
        return True
    slope = 1 / there - 1 / here
    bend_before = slope - (1 / here - 1 / depth[v_before, u_before])
    bend_after = (1 / depth[v_after, u_after] - 1 / there) - slope
    # not <=: unknown neighbours prove no plane
    return not max(abs(bend_before), abs(bend_after)) <= 0.3 * abs(slope)
