"""The world in pieces like objects: what stands in upright ones, the ground in few wide ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.simulated.gravity import coarse_points
from laser_slam.backbones.simulated.piece_kernels import Ground, no_seeds, object_keys

Array = NDArray[np.float64]
Map = NDArray[np.float32]

COLUMN = 0.25  # width of the columns in which ground is looked for, in median depths
THICKNESS = 0.03  # of the slab that counts as ground, in median depths
MIN_SHARE = 0.5  # of a column's points that its lowest slab holds where it is ground
MIN_POINTS = 4
MAX_COLUMNS = 512
LOWEST = 0.05  # share of the points that may lie below the ground: wrong ones


@dataclass(frozen=True)
class Pieces:
    """A partition of the world by position, fixed for a run.

    Attributes:
        size: of a piece, in median depths.
        median_m: metres of a median depth.
        level_from_world: (3, 3) rotation to axes with y down.
        salt: of the partition.
    """

    size: float
    median_m: float
    level_from_world: Array
    salt: np.uint64

    def ground(self, depths: list[Map], intrinsics: Array, world_from_cam: Array) -> Ground:
        """Find the ground of a window: columns of the world in which most lies at the bottom.

        Args:
            depths: N maps (H, W), true, in metres; NaN: unknown.
            intrinsics: (3, 3) in pixels of the maps.
            world_from_cam: (N, 4, 4) true, in metres.
        """
        points = [
            self._level(coarse_points(depth, intrinsics), pose)
            for depth, pose in zip(depths, world_from_cam, strict=True)
        ]
        return _find_ground(np.concatenate(points))

    def keys(
        self, depth: Map, intrinsics: Array, world_from_cam: Array, ground: Ground
    ) -> NDArray[np.uint64]:
        """Return (H, W) the piece that each pixel shows; 0 where depth is unknown."""
        level_from_pixel = np.empty((3, 4))
        rotation = self.level_from_world @ world_from_cam[:3, :3]
        level_from_pixel[:, :3] = rotation @ np.linalg.inv(intrinsics)
        level_from_pixel[:, 3] = self.level_from_world @ world_from_cam[:3, 3]
        level_from_pixel /= self.median_m
        out = np.zeros(depth.shape, np.uint64)
        object_keys(depth, level_from_pixel, self.size, ground, self.salt, no_seeds(), out)
        return out

    def _level(self, points: Array, world_from_cam: Array) -> Array:
        """Return the known points as (M, 3) in level axes and median depths."""
        known = points[np.isfinite(points[..., 2])]
        in_world = known @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        return np.asarray(in_world @ self.level_from_world.T / self.median_m)


def _find_ground(points: Array) -> Ground:
    """Find the ground under (M, 3) points in level axes and median depths."""
    nowhere = Ground(np.full((1, 1), np.inf, np.float32), 0.0, 0.0, COLUMN)
    if not len(points):
        return nowhere
    low = np.quantile(points[:, [0, 2]], 0.01, axis=0)
    cells = np.floor((points[:, [0, 2]] - low) / COLUMN).astype(np.int64)
    shape = np.minimum(np.floor(np.quantile(cells, 0.99, axis=0)).astype(np.int64) + 1, MAX_COLUMNS)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    if not inside.any():
        return nowhere
    column = cells[inside, 0] * shape[1] + cells[inside, 1]
    top = _level_columns(column, points[inside, 1], int(shape[0] * shape[1]))
    top = _spread(top.reshape(shape[0], shape[1])) - THICKNESS
    return Ground(top.astype(np.float32), float(low[0]), float(low[1]), COLUMN)


def _level_columns(column: NDArray[np.int64], y: Array, num: int) -> Array:
    """Return (num,) the ground's y of each column; inf where the most does not lie at the bottom.

    Args:
        column: (M,) of each point.
        y: (M,) of each point, down.
        num: of the columns.
    """
    order = np.lexsort((y, column))
    column, y = column[order], y[order]
    starts = np.searchsorted(column, np.arange(num + 1))
    count = np.diff(starts)
    lowest = starts[:-1] + (count * (1 - LOWEST)).astype(np.int64)
    level = np.where(count > 0, y[np.minimum(lowest, len(y) - 1)], np.inf)
    near = np.abs(y - level[column]) < THICKNESS
    share = np.bincount(column, near, num) / np.maximum(count, 1)
    return np.where((count >= MIN_POINTS) & (share >= MIN_SHARE), level, np.inf)


def _spread(level: Array) -> Array:
    """Give a column without ground that of its lowest neighbour: a car or a wall stands on it."""
    padded = np.pad(np.where(np.isfinite(level), level, -np.inf), 1, constant_values=-np.inf)
    rows, columns = level.shape
    around = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    lowest = np.max(around, axis=0)
    filled = np.where(np.isfinite(lowest), lowest, np.inf)
    return np.where(np.isfinite(level), level, filled)
