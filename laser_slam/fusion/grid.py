"""A growing hash table of voxels that average position and colour."""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.types import Cloud

Array = NDArray[np.float64]

_LOGGER = logging.getLogger(__name__)
_BITS = 21  # of a voxel's index per axis: three fit into one int64
_HALF = 1 << (_BITS - 1)
_MASK = (1 << _BITS) - 1
_FIRST_VOXELS = 1 << 16
_PORTION = 1 << 20  # voxels that are turned into points at once
_MAX_LOAD = 0.6  # of the table of slots: beyond it, open addressing gets slow


class View(NamedTuple):
    """One frame as the kernel wants it.

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


class _Voxels(NamedTuple):
    """The table: ``slots`` finds a voxel's row in the other arrays.

    Attributes:
        slots: (2^k,) row of a voxel, or -1.
        keys: (M,) packed voxel index.
        sums: (M, 7) weight; weight times position in the voxel (0..1 per axis), times RGB.
        seen: (M, 2) frames that saw the voxel; number of the last of them.
    """

    slots: NDArray[np.int32]
    keys: NDArray[np.int64]
    sums: NDArray[np.float32]
    seen: NDArray[np.int32]


class VoxelGrid:
    """Voxels that grow as frames come in.

    Rows are in the order of first sight, so that neighbouring pixels find neighbouring memory.
    Positions are summed relative to their voxel: float32 loses nothing far from the origin.
    """

    def __init__(self, voxel_size: float) -> None:
        self.voxel_size = voxel_size
        self.num_voxels = 0
        self.num_frames = 0
        self.num_outside = 0
        self.voxels = _allocate(_FIRST_VOXELS)

    def add(self, view: View, stride: int = 1) -> None:
        """Average every ``stride``-th row and column of one frame into the grid."""
        needed = self.num_voxels + int(np.count_nonzero(view.weight[::stride, ::stride]))
        if needed > len(self.voxels.keys):
            self._grow(needed)
        self.num_frames += 1
        state = (self.num_voxels, self.num_frames)
        self.num_voxels, outside = _integrate(
            view, self.voxels, state, 1.0 / self.voxel_size, stride
        )
        self.num_outside += outside

    def _grow(self, needed: int) -> None:
        old, num = self.voxels, self.num_voxels
        self.voxels = _allocate(max(needed, num + num // 2))
        self.voxels.keys[:num] = old.keys[:num]
        self.voxels.sums[:num] = old.sums[:num]
        self.voxels.seen[:num] = old.seen[:num]
        _index(self.voxels.slots, self.voxels.keys, num)

    def cloud(self, min_observations: int) -> Cloud:
        """Return the averages of all voxels with enough support."""
        if self.num_outside:
            _LOGGER.warning(
                "%d points lie more than %d voxels from the origin and stay out of the cloud; "
                "raise fusion.voxel_size",
                self.num_outside,
                _HALF,
            )
        kept = np.flatnonzero(_supported(self.voxels, self.num_voxels, min_observations))
        points, colors = np.empty((len(kept), 3)), np.empty((len(kept), 3), np.uint8)
        for start in range(0, len(kept), _PORTION):  # the map is large enough without copies of it
            part = slice(start, start + _PORTION)
            keys, sums = self.voxels.keys[kept[part]], self.voxels.sums[kept[part]]
            means = sums[:, 1:] / sums[:, :1]
            for axis, shift in enumerate((2 * _BITS, _BITS, 0)):
                corner = (keys >> shift & _MASK) - _HALF
                points[part, axis] = (corner + means[:, axis]) * self.voxel_size
            colors[part] = np.rint(means[:, 3:]).clip(0, 255)
        return Cloud(points, colors, self.voxels.sums[kept, 0], self.voxel_size)


def _allocate(num_voxels: int) -> _Voxels:
    num_slots = 1 << int(np.ceil(np.log2(num_voxels / _MAX_LOAD)))
    return _Voxels(
        slots=np.full(num_slots, -1, np.int32),
        keys=np.empty(num_voxels, np.int64),
        sums=np.zeros((num_voxels, 7), np.float32),
        seen=np.zeros((num_voxels, 2), np.int32),
    )


@njit(cache=True, nogil=True)
def _integrate(view: Any, voxels: Any, state: Any, per_voxel: float, stride: int) -> Any:
    """Add the pixels of one frame; return the number of voxels and of points out of reach."""
    num_voxels, frame = state
    height, width = view.depth.shape
    position = np.empty(3)
    outside, last_key, row = 0, np.int64(-1), 0
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            weight = view.weight[v, u]
            if not weight > 0:
                continue
            for k in range(3):
                ray = view.world_from_ray[k]
                along = ray[0] * u + ray[1] * v + ray[2]
                position[k] = (along * view.depth[v, u] + view.center[k]) * per_voxel
            key = _key(position)
            if key < 0:
                outside += 1
                continue
            if key != last_key:
                row = _row(key, voxels.slots, voxels.keys, num_voxels)
                num_voxels = max(num_voxels, row + 1)
                last_key = key
            _accumulate(voxels, row, weight, position, view.color[v, u])
            voxels.seen[row, 0] += voxels.seen[row, 1] != frame
            voxels.seen[row, 1] = frame
    return num_voxels, outside


@njit(cache=True, nogil=True, inline="always")
def _accumulate(voxels: Any, row: int, weight: float, position: Any, color: Any) -> None:
    sums = voxels.sums[row]
    sums[0] += weight
    for k in range(3):
        sums[1 + k] += weight * np.float32(position[k] - np.floor(position[k]))
        sums[4 + k] += weight * np.float32(color[k])


@njit(cache=True, nogil=True, inline="always")
def _key(position: Any) -> Any:
    """Pack the voxel that holds ``position`` (in voxels); -1: too far from the origin."""
    key = np.int64(0)
    for k in range(3):
        index = np.int64(np.floor(position[k])) + _HALF
        if index < 0 or index > _MASK:
            return np.int64(-1)
        key = (key << _BITS) | index
    return key


@njit(cache=True, nogil=True)
def _find(key: Any, slots: Any, keys: Any) -> Any:
    """Return the slot where ``key`` is, or the free one where it belongs."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(len(slots) - 1))
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & (len(slots) - 1)
    return slot


@njit(cache=True, nogil=True)
def _row(key: Any, slots: Any, keys: Any, num_voxels: int) -> Any:
    """Return the row of a voxel, the first free one for a new voxel."""
    slot = _find(key, slots, keys)
    if slots[slot] < 0:
        slots[slot] = num_voxels
        keys[num_voxels] = key
    return np.int64(slots[slot])


@njit(cache=True, nogil=True)
def _index(slots: Any, keys: Any, num_voxels: int) -> None:
    for row in range(num_voxels):
        slots[_find(keys[row], slots, keys)] = row


@njit(cache=True, nogil=True)
def _supported(voxels: Any, num_voxels: int, min_observations: int) -> Any:
    """Return (num_voxels,) True where a voxel and its 26 neighbours were seen often enough."""
    kept = np.zeros(num_voxels, np.bool_)
    for row in range(num_voxels):
        support = voxels.seen[row, 0]
        for neighbour in range(27):
            if support >= min_observations:
                break
            if neighbour == 13:
                continue
            x, y, z = neighbour // 9 - 1, neighbour // 3 % 3 - 1, neighbour % 3 - 1
            # at the very border the sum may carry over: a neighbour too many, never a crash
            key = voxels.keys[row] + (x << 2 * _BITS) + (y << _BITS) + z
            slot = _find(key, voxels.slots, voxels.keys)
            if voxels.slots[slot] >= 0:
                support += voxels.seen[voxels.slots[slot], 0]
        kept[row] = support >= min_observations
    return kept
