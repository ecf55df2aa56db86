"""Sums of voxels to finished tiles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import FusionConfig
from laser_slam.fusion.grid import Voxels
from laser_slam.fusion.keys import Cells, Keys, cells_of, corner_of, keys_of
from laser_slam.fusion.table import supported
from laser_slam.store import Place, SumFiles, Tile, TileEntry, TileFiles

_STEPS = 1 << 16  # of a position in its voxel
_MOST_VIEWS = np.iinfo(np.uint16).max
_PORTION = 1 << 18  # voxels that are averaged at once: temporary arrays stay small
_CACHED_RIMS = 512

Rim = tuple[Keys, NDArray[np.int32]]


class Finisher:
    """Average the voxels of tiles, and judge their support with that of the tiles around.

    Args:
        files: of the finished tiles.
        aside: of the unfinished ones.
        kept: the tiles that were finished before.
        config: how much support a voxel needs.
    """

    def __init__(
        self,
        files: TileFiles,
        aside: SumFiles,
        kept: Sequence[TileEntry],
        config: FusionConfig,
    ) -> None:
        self._files = files
        self._aside = aside
        self._kept = kept
        self._finished = {entry.place for entry in kept}
        self._bits = config.tile_bits
        self._least = config.min_observations
        self._rim = lru_cache(_CACHED_RIMS)(self._read_rim)

    def make(self, windows: Mapping[Place, Sequence[int]]) -> list[TileEntry]:
        """Finish the tiles that were put aside.

        Args:
            windows: whose pixels each of them has.

        Raises:
            RunFolderError: a tile cannot be read or written.
        """
        entries = []
        for place in sorted(self._aside.places):
            stored, corner = self._aside.load(place), corner_of(place, self._bits)
            voxels = Voxels(keys_of(stored.cells, corner), stored.sums, stored.views)
            tile = finish_tile(voxels, corner, self._rims(place), self._least)
            self._files.save(place, tile, 1 << self._bits)
            entries.append(_entry(place, tile, windows[place]))
        return entries

    def judge(self, changed: Set[Place]) -> list[TileEntry]:
        """Judge those that were finished before anew, where they border on changed ones.

        Only tiles with other points than before are written.

        Raises:
            RunFolderError: a tile cannot be read or written.
        """
        entries = []
        for entry in self._kept:
            if changed.isdisjoint(_around(entry.place)):
                entries.append(entry)
                continue
            tile = self._files.load(entry.place)
            rims = self._rims(entry.place)
            is_kept = _judge(tile.cells, tile.views, tile.corner, rims, self._least)
            if not np.array_equal(is_kept, tile.is_kept):
                tile = replace(tile, is_kept=is_kept)
                self._files.save(entry.place, tile, 1 << self._bits)
            entries.append(_entry(entry.place, tile, entry.windows))
        return entries

    def _rims(self, place: Place) -> list[Rim]:
        there = self._aside.places | self._finished
        return [self._rim(around) for around in _around(place) if around in there]

    def _read_rim(self, place: Place) -> Rim:
        source: SumFiles | TileFiles = self._aside if place in self._aside.places else self._files
        cells, views = source.rim(place)
        return keys_of(cells, corner_of(place, self._bits)), views.astype(np.int32)


def finish_tile(voxels: Voxels, corner: NDArray[np.int64], rims: Iterable[Rim], least: int) -> Tile:
    """Average the voxels of one tile, and judge which have enough support.

    Args:
        voxels: of the tile.
        corner: (3,) of the tile.
        rims: packed voxels, and their views, of the tiles around it, at least those that touch it.
        least: views that a voxel and its neighbours need in sum.
    """
    num = len(voxels.keys)
    offsets, colors = np.empty((num, 3), np.uint16), np.empty((num, 3), np.uint8)
    normals = np.empty((num, 3), np.int8)
    for start in range(0, num, _PORTION):
        part = slice(start, start + _PORTION)
        means = voxels.sums[part, 1:] / voxels.sums[part, :1]
        offsets[part] = (means[:, :3] * _STEPS).clip(0, _STEPS - 1)
        colors[part] = np.rint(means[:, 3:6]).clip(0, 255)
        length = np.linalg.norm(means[:, 6:], axis=1, keepdims=True)
        normals[part] = np.rint(127 * means[:, 6:] / np.maximum(length, 1e-12))
    views = voxels.views.clip(0, _MOST_VIEWS).astype(np.uint16)
    cells = cells_of(voxels.keys, corner)
    is_kept = _judge(cells, views, corner, rims, least)
    return Tile(corner, cells, offsets, colors, normals, voxels.sums[:, 0].copy(), views, is_kept)


def _judge(
    cells: Cells,
    views: NDArray[np.uint16],
    corner: NDArray[np.int64],
    rims: Iterable[Rim],
    least: int,
) -> NDArray[np.bool_]:
    parts = [(keys_of(cells, corner), views.astype(np.int32)), *rims]
    keys = np.concatenate([keys for keys, _ in parts])
    all_views = np.concatenate([views for _, views in parts])
    return supported(keys, all_views, len(cells), least)


def _entry(place: Place, tile: Tile, windows: Sequence[int]) -> TileEntry:
    return TileEntry(place, int(tile.is_kept.sum()), len(tile.views), tuple(windows))


def _around(place: Place) -> list[Place]:
    x, y, z = place
    steps = product((-1, 0, 1), repeat=3)
    return [(x + dx, y + dy, z + dz) for dx, dy, dz in steps if dx or dy or dz]
