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
# _nrt=False leaves out the counting of references to arrays, which took most of the time.
kernel = njit(cache=True, nogil=True, _nrt=False)
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


class Seeds(NamedTuple):
    """The seeds of the 2x2x2 cells around the last pixel, of objects (0) and of the ground (1).

    Whole arrays and an index: a view for each pixel would cost more than all the rest.
    """

    base: NDArray[np.int64]  # (2, 3) the first cell
    places: Array  # (2, 8, 3) in cells
    keys: NDArray[np.uint64]  # (2, 8)
    reach: Array  # (2, 8) squared distance within which no other seed is nearer
    last: NDArray[np.int64]  # (2,) the seed of the last pixel


def no_seeds() -> Seeds:
    """Return the seeds before the first pixel."""
    return Seeds(
        np.full((2, 3), 1 << 40),
        np.empty((2, 8, 3)),
        np.empty((2, 8), np.uint64),
        np.empty((2, 8)),
        np.zeros(2, np.int64),
    )


@kernel
def _strew(seeds: Seeds, kind: int, salt: np.uint64) -> None:
    """Place the seeds of the cells from ``base`` on."""
    for i in range(8):
        ix = seeds.base[kind, 0] + (i & 1)
        iy = seeds.base[kind, 1] + ((i >> 1) & 1)
        iz = seeds.base[kind, 2] + (i >> 2)
        bits = mix_cell(ix, iy, iz, salt)
        seeds.keys[kind, i] = bits >> np.uint64(1)
        seeds.places[kind, i, 0] = ix + 0.5 + JITTER * (uniform(bits, 0) - 0.5)
        seeds.places[kind, i, 1] = iy + 0.5 + JITTER * (uniform(bits, 1) - 0.5)
        seeds.places[kind, i, 2] = iz + 0.5 + JITTER * (uniform(bits, 2) - 0.5)
    for i in range(8):
        least = np.inf
        for j in range(8):
            if j != i:
                x, y = seeds.places[kind, j, 0], seeds.places[kind, j, 1]
                least = min(least, _gap(seeds, kind, i, x, y, seeds.places[kind, j, 2]))
        seeds.reach[kind, i] = least / 4  # half the distance


@njit(cache=True, nogil=True, forceinline=True, _nrt=False)
def _gap(seeds: Seeds, kind: int, i: int, x: float, y: float, z: float) -> float:
    """Return the squared distance to a seed."""
    dx = x - seeds.places[kind, i, 0]
    dy = y - seeds.places[kind, i, 1]
    dz = z - seeds.places[kind, i, 2]
    return float(dx * dx + dy * dy + dz * dz)


@kernel
def _nearest(seeds: Seeds, kind: int, x: float, y: float, z: float, salt: np.uint64) -> np.uint64:
    """Return the key of the nearest of the 8 seeds around; neighbouring pixels share them."""
    ix, iy, iz = int(np.floor(x - 0.5)), int(np.floor(y - 0.5)), int(np.floor(z - 0.5))
    base, best = seeds.base, seeds.last[kind]
    if ix != base[kind, 0] or iy != base[kind, 1] or iz != base[kind, 2]:
        base[kind, 0], base[kind, 1], base[kind, 2] = ix, iy, iz
        _strew(seeds, kind, salt)
    least = _gap(seeds, kind, best, x, y, z)
    if least > seeds.reach[kind, best]:
        for i in range(8):
            gap = _gap(seeds, kind, i, x, y, z)
            if gap < least:
                best, least = i, gap
        seeds.last[kind] = best
    return np.uint64(seeds.keys[kind, best])


@kernel
def object_keys(
    depth: NDArray[np.float32],
    level_from_pixel: Array,
    size: float,
    ground: Ground,
    salt: np.uint64,
    seeds: Seeds,
    out: NDArray[np.uint64],
) -> None:
    """Find the piece of the world that each pixel shows.

    Args:
        depth: (H, W) z in any unit; NaN: unknown.
        level_from_pixel: (3, 4) maps (u z, v z, z, 1) to level axes (y down), in median depths.
        size: of a piece, in median depths.
        ground: where ground is.
        salt: of the partition.
        seeds: of no pixel yet; memory for the kernel.
        out: (H, W) zeros, is filled with keys; 0: unknown. Those of the ground have the highest
            bit.
    """
    M = level_from_pixel
    per_column, wide, columns = 1 / ground.column, 1 / (size * GROUND_WIDER), ground.top.shape
    per_size, per_height = 1 / size, 1 / (size * TALLER)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if not z > 0:
                continue
            x = (M[0, 0] * u + M[0, 1] * v + M[0, 2]) * z + M[0, 3]
            y = (M[1, 0] * u + M[1, 1] * v + M[1, 2]) * z + M[1, 3]
            w = (M[2, 0] * u + M[2, 1] * v + M[2, 2]) * z + M[2, 3]
            ix = int(np.floor((x - ground.x) * per_column))
            iz = int(np.floor((w - ground.z) * per_column))
            inside = 0 <= ix < columns[0] and 0 <= iz < columns[1]
            if inside and y > ground.top[ix, iz]:
                key = _nearest(seeds, 1, x * wide, 0.0, w * wide, salt + np.uint64(1))
                out[v, u] = key | GROUND_TAG
            else:
                out[v, u] = _nearest(seeds, 0, x * per_size, y * per_height, w * per_size, salt)
