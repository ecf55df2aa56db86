"""The cloud that a run would have without any filter, to be seen beside the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import unproject
from laser_slam.types import Cloud, Submap

MOST = 1_500_000  # points, of the whole run


class RawCloud:
    """An even share of all pixels with depth, whatever their confidence; nothing is averaged."""

    def __init__(self, num_keyframes: int) -> None:
        """Start with none.

        Args:
            num_keyframes: of the run, which share the points.
        """
        self._per_frame = max(1, MOST // max(1, num_keyframes))
        self._parts: dict[int, tuple[NDArray[np.float64], NDArray[np.uint8]]] = {}

    def has(self, index: int) -> bool:
        """Tell whether a window was there."""
        return index in self._parts

    def add(self, submap: Submap) -> None:
        """Take pixels of the frames that a window owns; a window that comes again counts once."""
        frames = [self._pick(submap, int(i)) for i in np.flatnonzero(submap.is_owned)]
        points = [picked[0] for picked in frames] or [np.zeros((0, 3))]
        colors = [picked[1] for picked in frames] or [np.zeros((0, 3), np.uint8)]
        self._parts[submap.index] = np.concatenate(points), np.concatenate(colors)

    def cloud(self, voxel_size: float) -> Cloud:
        """Return the points in world units.

        Args:
            voxel_size: how far apart points are taken to be, as those of the map.
        """
        parts = self._parts.values()
        points = np.concatenate([np.zeros((0, 3)), *(part[0] for part in parts)])
        colors = np.concatenate([np.zeros((0, 3), np.uint8), *(part[1] for part in parts)])
        return Cloud(points, colors, np.ones(len(points), np.float32), voxel_size)

    def _pick(self, submap: Submap, i: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        window = submap.prediction
        known = np.flatnonzero((window.depth[i] > 0) & np.isfinite(window.depth[i]))
        if len(known) > self._per_frame:
            rng = np.random.default_rng(int(window.frames[i]))
            known = rng.choice(known, self._per_frame, replace=False)
        place = submap.places[i] if submap.places else submap.world_from_window
        world_from_cam = place.apply_poses(window.window_from_cam[i])
        points = unproject(window.depth[i], window.intrinsics[i]).reshape(-1, 3)[known]
        world = place.scale * points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        return world, submap.colors[i].reshape(-1, 3)[known]
