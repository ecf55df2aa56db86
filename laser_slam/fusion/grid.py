"""Voxels that average position, colour and normal; they grow as frames come in."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.fusion.keys import Keys, key_at, tile_at, tiles_of
from laser_slam.fusion.table import Slots, empty_slots, index_rows, row_of
from laser_slam.fusion.views import View, surface_normal

_FIRST_VOXELS = 1 << 16
_NUM_SUMS = 10


class Voxels(NamedTuple):
    """Voxels in the order of first sight.

    Attributes:
        keys: (M,) packed voxel.
        sums: (M, 10) weight; weight times position in the voxel (0..1 per axis), times RGB, times
            unit normal.
        views: (M,) frames that saw the voxel.
    """

    keys: Keys
    sums: NDArray[np.float32]
    views: NDArray[np.int32]


class _Table(NamedTuple):
    """Voxels with room for more: ``slots`` finds a voxel's row in the other arrays.

    Attributes:
        slots: (2^k,) row of a voxel, or -1.
        keys: (M,) as in ``Voxels``.
        sums: (M, 10) as in ``Voxels``.
        seen: (M, 2) frames that saw the voxel; number of the last of them.
    """

    slots: Slots
    keys: Keys
    sums: NDArray[np.float32]
    seen: NDArray[np.int32]


class Located(NamedTuple):
    """Where the pixels of one frame lie.

    Attributes:
        pixels: (N,) flat index of each pixel that counts.
        keys: (N,) packed voxel.
        inside: (N, 3) position in the voxel, 0..1.
        ordinals: (N,) row of its tile in ``tiles``.
        tiles: (T,) packed tiles that the frame touches.
        num_outside: points that no index reaches.
    """

    pixels: NDArray[np.int32]
    keys: Keys
    inside: NDArray[np.float32]
    ordinals: NDArray[np.int32]
    tiles: Keys
    num_outside: int


class VoxelGrid:
    """Voxels that come with the frames, and go and come back tile by tile.

    Rows are in the order of first sight, so that neighbouring pixels find neighbouring memory.
    Positions are summed relative to their voxel: float32 loses nothing far from the origin.

    Args:
        voxel_size: edge of a voxel in world units.
        tile_bits: a tile is a cube of 2^tile_bits voxels.
    """

    def __init__(self, voxel_size: float, tile_bits: int) -> None:
        self.voxel_size = voxel_size
        self.tile_bits = tile_bits
        self.num_voxels = 0
        self._num_frames = 0
        self._table = _allocate(_FIRST_VOXELS)

    @property
    def num_reserved(self) -> int:
        """Return for how many voxels there is memory."""
        return len(self._table.keys)

    def locate(self, view: View, stride: int = 1) -> Located:
        """Find voxel and tile of every ``stride``-th row's and column's pixels."""
        num = view.weight[::stride, ::stride].size
        out = Located(
            np.empty(num, np.int32),
            np.empty(num, np.int64),
            np.empty((num, 3), np.float32),
            np.empty(num, np.int32),
            np.empty(num, np.int64),
            0,
        )
        num, num_tiles, outside = _locate(view, out, 1 / self.voxel_size, stride, self.tile_bits)
        return Located(
            out.pixels[:num],
            out.keys[:num],
            out.inside[:num],
            out.ordinals[:num],
            out.tiles[:num_tiles],
            outside,
        )

    def add(self, view: View, located: Located, is_wanted: NDArray[np.bool_]) -> None:
        """Average the pixels of one frame that lie in wanted tiles.

        Args:
            view: the frame.
            located: where its pixels lie.
            is_wanted: (T,) of the tiles of ``located``.
        """
        self._reserve(len(located.pixels))
        self._num_frames += 1
        state = (self.num_voxels, self._num_frames)
        self.num_voxels = _integrate(view, located, is_wanted, self._table, state)

    def put(self, voxels: Voxels) -> None:
        """Take voxels back that were taken out; none of them may be here."""
        self._reserve(len(voxels.keys))
        start, stop = self.num_voxels, self.num_voxels + len(voxels.keys)
        self._table.keys[start:stop] = voxels.keys
        self._table.sums[start:stop] = voxels.sums
        self._table.seen[start:stop, 0] = voxels.views
        self._table.seen[start:stop, 1] = 0
        index_rows(self._table.slots, self._table.keys, start, stop)
        self.num_voxels = stop

    def take(self, tiles: Keys) -> list[Voxels]:
        """Take the voxels of some tiles out, tile by tile.

        Args:
            tiles: (T,) packed, rising.
        """
        num, table = self.num_voxels, self._table
        owners = tiles_of(table.keys[:num], self.tile_bits)
        found = np.minimum(np.searchsorted(tiles, owners), len(tiles) - 1)
        is_taken = tiles[found] == owners
        taken = np.flatnonzero(is_taken)
        taken = taken[np.argsort(found[taken], kind="stable")]
        ends = np.cumsum(np.bincount(found[is_taken], minlength=len(tiles)))
        parts = [
            Voxels(table.keys[rows], table.sums[rows], table.seen[rows, 0])
            for rows in np.split(taken, ends[:-1])
        ]
        self._keep(np.flatnonzero(~is_taken))
        return parts

    def counts(self) -> dict[int, int]:
        """Tell how many voxels each tile has here."""
        owners = tiles_of(self._table.keys[: self.num_voxels], self.tile_bits)
        tiles, counts = np.unique(owners, return_counts=True)
        return dict(zip(tiles.tolist(), counts.tolist(), strict=True))

    def _reserve(self, num: int) -> None:
        needed, num_voxels = self.num_voxels + num, self.num_voxels
        if needed <= len(self._table.keys):
            return
        old = self._table
        self._table = _allocate(max(needed, num_voxels + num_voxels // 2))
        self._table.keys[:num_voxels] = old.keys[:num_voxels]
        self._table.sums[:num_voxels] = old.sums[:num_voxels]
        self._table.seen[:num_voxels] = old.seen[:num_voxels]
        index_rows(self._table.slots, self._table.keys, 0, num_voxels)

    def _keep(self, rows: NDArray[np.int64]) -> None:
        """Forget all other rows; free the memory if few are left."""
        old = self._table
        self._table = _allocate(max(len(rows), _FIRST_VOXELS))
        self._table.keys[: len(rows)] = old.keys[rows]
        self._table.sums[: len(rows)] = old.sums[rows]
        self._table.seen[: len(rows)] = old.seen[rows]
        index_rows(self._table.slots, self._table.keys, 0, len(rows))
        self.num_voxels = len(rows)


def _allocate(num_voxels: int) -> _Table:
    return _Table(
        slots=empty_slots(num_voxels),
        keys=np.empty(num_voxels, np.int64),
        sums=np.zeros((num_voxels, _NUM_SUMS), np.float32),
        seen=np.zeros((num_voxels, 2), np.int32),
    )


@njit(cache=True, nogil=True)
def _locate(view: Any, out: Any, per_voxel: float, stride: int, tile_bits: int) -> Any:
    """Fill ``out``; return the number of pixels, of tiles, and of points out of reach."""
    height, width = view.depth.shape
    position = np.empty(3)
    num, num_tiles, ordinal, outside, last_key = 0, 0, 0, 0, np.int64(-1)
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            if not view.weight[v, u] > 0:
                continue
            for k in range(3):
                ray = view.world_from_ray[k]
                along = ray[0] * u + ray[1] * v + ray[2]
                position[k] = (along * view.depth[v, u] + view.center[k]) * per_voxel
            key = key_at(position)
            if key < 0:
                outside += 1
                continue
            if key != last_key:
                ordinal, num_tiles = _ordinal(
                    tile_at(key, tile_bits), out.tiles, ordinal, num_tiles
                )
                last_key = key
            out.pixels[num] = v * width + u
            out.keys[num] = key
            out.ordinals[num] = ordinal
            for k in range(3):
                out.inside[num, k] = position[k] - np.floor(position[k])
            num += 1
    return num, num_tiles, outside


@njit(cache=True, nogil=True)
def _ordinal(tile: Any, tiles: Any, last: int, num_tiles: int) -> Any:
    """Return the row of a tile among those met before, and how many were met by now."""
    if num_tiles > 0 and tiles[last] == tile:
        return last, num_tiles
    for row in range(num_tiles):
        if tiles[row] == tile:
            return row, num_tiles
    tiles[num_tiles] = tile
    return num_tiles, num_tiles + 1


@njit(cache=True, nogil=True)
def _integrate(view: Any, located: Any, is_wanted: Any, table: Any, state: Any) -> Any:
    """Add the pixels of one frame; return the number of voxels."""
    num_voxels, frame = state
    width = view.depth.shape[1]
    last_key, row = np.int64(-1), 0
    for i in range(len(located.pixels)):
        if not is_wanted[located.ordinals[i]]:
            continue
        v, u = located.pixels[i] // width, located.pixels[i] % width
        key, weight = located.keys[i], view.weight[v, u]
        if key != last_key:
            row = row_of(key, table.slots, table.keys, num_voxels)
            num_voxels = max(num_voxels, row + 1)
            last_key = key
        sums, normal = table.sums[row], surface_normal(view, v, u)
        sums[0] += weight
        for k in range(3):
            sums[1 + k] += weight * located.inside[i, k]
            sums[4 + k] += weight * np.float32(view.color[v, u, k])
            sums[7 + k] += weight * np.float32(normal[k])
        table.seen[row, 0] += table.seen[row, 1] != frame
        table.seen[row, 1] = frame
    return num_voxels
