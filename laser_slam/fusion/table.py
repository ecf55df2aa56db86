"""Open addressing: which row of other arrays a voxel has."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.fusion.keys import BITS, Keys

Slots = NDArray[np.int32]

_MAX_LOAD = 0.6  # of the slots: beyond it, open addressing gets slow


def empty_slots(num_voxels: int) -> Slots:
    """Return slots for so many voxels, all free."""
    return np.full(1 << int(np.ceil(np.log2(max(num_voxels, 1) / _MAX_LOAD))), -1, np.int32)


@njit(cache=True, nogil=True)
def find(key: Any, slots: Any, keys: Any) -> Any:
    """Return the slot where ``key`` is, or the free one where it belongs."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(len(slots) - 1))
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & (len(slots) - 1)
    return slot


@njit(cache=True, nogil=True)
def row_of(key: Any, slots: Any, keys: Any, num_voxels: int) -> Any:
    """Return the row of a voxel, the first free one for a new voxel."""
    slot = find(key, slots, keys)
    if slots[slot] < 0:
        slots[slot] = num_voxels
        keys[num_voxels] = key
    return np.int64(slots[slot])


@njit(cache=True, nogil=True)
def index_rows(slots: Any, keys: Any, start: int, stop: int) -> None:
    """Enter rows ``start`` to ``stop`` of ``keys``, each key once."""
    for row in range(start, stop):
        slots[find(keys[row], slots, keys)] = row


def supported(keys: Keys, views: NDArray[np.int32], num: int, least: int) -> NDArray[np.bool_]:
    """Tell which voxels were, together with their 26 neighbours, seen often enough.

    Args:
        keys: (M,) packed voxels, each once.
        views: (M,) frames that saw the voxel.
        num: how many of the first voxels to judge; the others are neighbours only.
        least: views that a voxel and its neighbours need in sum.

    Returns:
        (num,) True where there are as many.
    """
    slots = empty_slots(len(keys))
    index_rows(slots, keys, 0, len(keys))
    return np.asarray(_supported(slots, keys, views, num, least))


@njit(cache=True, nogil=True)
def _supported(slots: Any, keys: Any, views: Any, num: int, least: int) -> Any:
    kept = np.zeros(num, np.bool_)
    for row in range(num):
        support = views[row]
        for neighbour in range(27):
            if support >= least:
                break
            if neighbour == 13:
                continue
            x, y, z = neighbour // 9 - 1, neighbour // 3 % 3 - 1, neighbour % 3 - 1
            # at the very border the sum may carry over: a neighbour too many, never a crash
            key = keys[row] + (x << 2 * BITS) + (y << BITS) + z
            slot = find(key, slots, keys)
            if slots[slot] >= 0:
                support += views[slots[slot]]
        kept[row] = support >= least
    return kept
