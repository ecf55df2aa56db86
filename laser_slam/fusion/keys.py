"""Voxels and tiles as integers: three indices packed into one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Keys = NDArray[np.int64]
Cells = NDArray[np.uint16]

BITS = 21  # of a voxel's index per axis: three fit into one int64
HALF = 1 << (BITS - 1)
_MASK = (1 << BITS) - 1
_SHIFTS = (2 * BITS, BITS, 0)


@njit(cache=True, nogil=True, inline="always")
def key_at(position: Any) -> Any:
    """Pack the voxel that holds ``position`` (in voxels); -1: too far from the origin."""
    key = np.int64(0)
    for k in range(3):
        index = np.int64(np.floor(position[k])) + HALF
        if index < 0 or index > _MASK:
            return np.int64(-1)
        key = (key << BITS) | index
    return key


@njit(cache=True, nogil=True, inline="always")
def tile_at(key: Any, tile_bits: int) -> Any:
    """Pack the tile that holds a voxel: the origin lies in the middle of one, not on a border."""
    half = (1 << tile_bits) >> 1
    tile = np.int64(0)
    for shift in (2 * BITS, BITS, 0):
        tile = (tile << BITS) | ((((key >> shift) & _MASK) + half) >> tile_bits)
    return tile


def tiles_of(keys: Keys, tile_bits: int) -> Keys:
    """Return the packed tile of each voxel; see ``tile_at``."""
    half = (1 << tile_bits) >> 1
    out = np.zeros_like(keys)
    for shift in _SHIFTS:
        out |= ((keys >> shift & _MASK) + half >> tile_bits) << shift
    return out


def place_of(tile: int, tile_bits: int) -> tuple[int, int, int]:
    """Unpack a tile: its indices, counted from the tile with the world's origin."""
    middle = HALF >> tile_bits
    x, y, z = ((int(tile) >> shift & _MASK) - middle for shift in _SHIFTS)
    return x, y, z


def tile_of(place: tuple[int, int, int], tile_bits: int) -> int:
    """Pack a tile; the inverse of ``place_of``."""
    middle = HALF >> tile_bits
    return sum(part + middle << shift for part, shift in zip(place, _SHIFTS, strict=True))


def corner_of(place: tuple[int, int, int], tile_bits: int) -> NDArray[np.int64]:
    """Return the (3,) voxel at a tile's lowest corner, counted from the world's origin."""
    return (np.array(place, np.int64) << tile_bits) - ((1 << tile_bits) >> 1)


def cells_of(keys: Keys, corner: NDArray[np.int64]) -> Cells:
    """Return (M, 3) voxels of a tile, counted from its corner."""
    indices = np.stack([(keys >> shift & _MASK) for shift in _SHIFTS], axis=1)
    return np.asarray(indices - HALF - corner, np.uint16)


def keys_of(cells: Cells, corner: NDArray[np.int64]) -> Keys:
    """Pack (M, 3) voxels of a tile; the inverse of ``cells_of``."""
    indices = cells + (corner + HALF)
    return np.asarray(indices[:, 0] << 2 * BITS | indices[:, 1] << BITS | indices[:, 2], np.int64)
