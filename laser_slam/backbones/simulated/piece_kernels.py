"""Pieces of the world by position: a point is in the same piece wherever it is seen from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.backbones.simulated.hash_kernels import mix_cell, uniform

Array = NDArray[np.float64]

JITTER = 0.5  # of a cell, that the seeds are strewn over: less than 1 keeps pieces from slivers
TALLER = 2.0  # a piece is so much taller than wide: facades, cars and trees stand upright
GROUND_WIDER = 8.0  # a piece of ground is so much wider than one of what stands on it
GROUND_TAG = np.uint64(1) << np.uint64(63)


class Ground(NamedTuple):
    """The height of the ground over a grid of columns, in level axes and median depths.

    Attributes:
        top: (X, Z) y (down) above which nothing is ground; inf: no ground in this column.
        x: of the first column's border.
        z: of the first column's border.
        column: width of a column.
    """

    top: NDArray[np.float32]
    x: float
    z: float
    column: float


@njit(cache=True, nogil=True)
def _strew(
    base: NDArray[np.int64], salt: np.uint64, seeds: Array, keys: NDArray[np.uint64]
) -> None:
    """Place the seeds of the 2x2x2 cells from ``base`` on."""
    for i in range(8):
        ix, iy, iz = base[0] + (i & 1), base[1] + ((i >> 1) & 1), base[2] + (i >> 2)
        keys[i] = mix_cell(ix, iy, iz, salt) >> np.uint64(1)
        bits = mix_cell(ix, iy, iz, salt + np.uint64(1))
        seeds[i, 0] = ix + 0.5 + JITTER * (uniform(bits, 0) - 0.5)
        seeds[i, 1] = iy + 0.5 + JITTER * (uniform(bits, 1) - 0.5)
        seeds[i, 2] = iz + 0.5 + JITTER * (uniform(bits, 2) - 0.5)


@njit(cache=True, nogil=True)
def _nearest(
    place: Array,
    salt: np.uint64,
    base: NDArray[np.int64],
    seeds: Array,
    keys: NDArray[np.uint64],
) -> np.uint64:
    """Return the key of the nearest of the 8 seeds around; neighbouring pixels share them."""
    moved = False
    for axis in range(3):
        cell = int(np.floor(place[axis] - 0.5))
        moved |= cell != base[axis]
        base[axis] = cell
    if moved:
        _strew(base, salt, seeds, keys)
    best, least = 0, np.inf
    for i in range(8):
        dx, dy, dz = place[0] - seeds[i, 0], place[1] - seeds[i, 1], place[2] - seeds[i, 2]
        gap = dx * dx + dy * dy + dz * dz
        if gap < least:
            best, least = i, gap
    return np.uint64(keys[best])


@njit(cache=True, nogil=True)
def object_keys(
    depth: NDArray[np.float32],
    level_from_pixel: Array,
    size: float,
    ground: Ground,
    salt: np.uint64,
) -> NDArray[np.uint64]:
    """Return the piece of the world that each pixel shows.

    Args:
        depth: (H, W) z in any unit; NaN: unknown.
        level_from_pixel: (3, 4) maps (u z, v z, z, 1) to level axes (y down), in median depths.
        size: of a piece, in median depths.
        ground: where ground is.
        salt: of the partition.

    Returns:
        (H, W) keys; 0: unknown. Those of the ground have the highest bit.
    """
    M, out = level_from_pixel, np.zeros(depth.shape, np.uint64)
    place = np.empty(3)
    bases, seeds = np.full((2, 3), 1 << 40), np.empty((2, 8, 3))
    keys = np.empty((2, 8), np.uint64)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if not z > 0:
                continue
            x = (M[0, 0] * u + M[0, 1] * v + M[0, 2]) * z + M[0, 3]
            y = (M[1, 0] * u + M[1, 1] * v + M[1, 2]) * z + M[1, 3]
            w = (M[2, 0] * u + M[2, 1] * v + M[2, 2]) * z + M[2, 3]
            ix = int(np.floor((x - ground.x) / ground.column))
            iz = int(np.floor((w - ground.z) / ground.column))
            inside = 0 <= ix < ground.top.shape[0] and 0 <= iz < ground.top.shape[1]
            kind = 1 if inside and y > ground.top[ix, iz] else 0
            cell = size * GROUND_WIDER if kind else size
            place[0], place[1], place[2] = x / cell, 0.0 if kind else y / (TALLER * cell), w / cell
            key = _nearest(place, salt + np.uint64(2 * kind), bases[kind], seeds[kind], keys[kind])
            out[v, u] = key | GROUND_TAG if kind else key
    return out
