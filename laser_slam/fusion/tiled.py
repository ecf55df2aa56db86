"""A map in tiles: made in bounded memory, and made anew only where something changed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from laser_slam.config import FusionConfig
from laser_slam.errors import RunFolderError
from laser_slam.fusion.accumulation import Accumulator, reach
from laser_slam.fusion.finishing import Finisher
from laser_slam.fusion.views import automatic_voxel_size
from laser_slam.store import Place, SumFiles, TileEntry, TileFiles, TileIndex
from laser_slam.types import Submap

Load = Callable[[int], Submap]
Watch = Callable[[int, int], None]

_OF_MEMORY = {"active_voxels", "cloud_points"}  # settings that change no point
_SAME_SIZE = 1e-6  # relative: an optimisation moves the first window by as much without reason


@dataclass(frozen=True)
class Part:
    """One window's part of the map, before it is read.

    Attributes:
        index: of the window.
        fingerprint: differs whenever depth, colours, layers or place do.
    """

    index: int
    fingerprint: str


@dataclass(frozen=True)
class Update:
    """What an update did.

    Attributes:
        loaded: windows that were read for their pixels, in order.
        made: tiles that were made, or made anew, from pixels.
    """

    loaded: tuple[int, ...] = ()
    made: tuple[Place, ...] = ()


@dataclass(frozen=True)
class _Plan:
    """What is to be done: tiles to make anew (None: all), windows to read, tiles that stay."""

    dirty: frozenset[Place] | None
    windows: Sequence[int]
    kept: Sequence[TileEntry]


class TiledMap:
    """The map of one run on disk.

    Args:
        files: where the tiles are.
        config: filters, voxels and tiles.
    """

    def __init__(self, files: TileFiles, config: FusionConfig) -> None:
        self._files = files
        self._config = config

    def update(self, parts: Sequence[Part], load: Load, watch: Watch | None = None) -> Update:
        """Bring the map to what these windows make of it.

        What a map from scratch would be comes out, bit by bit; but only windows and tiles that a
        change touches are read and written.

        Args:
            parts: all windows, in order.
            load: gives a window's submap at its place, layers applied.
            watch: is told how many windows are done, and of how many.

        Raises:
            RunFolderError: tiles cannot be read or written.
        """
        voxel_size = self._voxel_size(parts, load)
        old = self._usable(voxel_size)
        if old is not None:
            voxel_size = old.voxel_size
        plan = self._plan(old, parts, load, voxel_size)
        if old is not None and not plan.dirty and old.windows == _fingerprints(parts):
            return Update()
        self._files.open(entry.place for entry in plan.kept)
        aside = SumFiles(self._files.folder / "aside")
        try:
            made, kept = self._make(plan, voxel_size, aside, (load, watch))
        finally:
            aside.remove()
        entries = sorted([*made, *kept], key=lambda entry: entry.place)
        self._files.save_index(
            TileIndex(voxel_size, self._settings(), _fingerprints(parts), entries)
        )
        return Update(tuple(plan.windows), tuple(entry.place for entry in made))

    def _make(
        self, plan: _Plan, voxel_size: float, aside: SumFiles, using: tuple[Load, Watch | None]
    ) -> tuple[list[TileEntry], list[TileEntry]]:
        """Make the tiles that are to be made; return them, and those that stay."""
        load, watch = using
        sums = Accumulator(aside, self._config, voxel_size, plan.dirty)
        for row, index in enumerate(plan.windows):
            sums.add(load(index))
            if watch is not None:
                watch(row + 1, len(plan.windows))
        sums.flush()
        finisher = Finisher(self._files, aside, plan.kept, self._config)
        return finisher.make(sums.windows), finisher.judge(plan.dirty or frozenset())

    def _settings(self) -> dict[str, Any]:
        return self._config.model_dump(mode="json", exclude=_OF_MEMORY)

    def _voxel_size(self, parts: Sequence[Part], load: Load) -> float:
        """Return the edge of the voxels in world units; 0: nothing was seen."""
        if self._config.voxel_size:
            return self._config.voxel_size
        sizes = (automatic_voxel_size(load(part.index), self._config) for part in parts)
        return next((size for size in sizes if size is not None), 0.0)

    def _usable(self, voxel_size: float) -> TileIndex | None:
        """Return the index of the map that is there, if its tiles may stay."""
        try:
            index = self._files.index()
        except RunFolderError:  # none, or none that can be read: made anew
            return None
        is_same = np.isclose(index.voxel_size, voxel_size, rtol=_SAME_SIZE, atol=0)
        return index if is_same and index.settings == self._settings() else None

    def _plan(
        self, old: TileIndex | None, parts: Sequence[Part], load: Load, voxel_size: float
    ) -> _Plan:
        windows = [part.index for part in parts]
        if old is None:
            return _Plan(None, windows if voxel_size else [], [])
        now = _fingerprints(parts)
        same = {index for index in now if old.windows.get(index) == now[index]}
        dirty = {entry.place for entry in old.tiles if not same.issuperset(entry.windows)}
        for index in windows:
            if index not in same:
                dirty |= reach(load(index), self._config, voxel_size)
        touched = {index for entry in old.tiles if entry.place in dirty for index in entry.windows}
        needed = [index for index in windows if index not in same or index in touched]
        kept = [entry for entry in old.tiles if entry.place not in dirty]
        return _Plan(frozenset(dirty), needed, kept)


def _fingerprints(parts: Iterable[Part]) -> dict[int, str]:
    return {part.index: part.fingerprint for part in parts}
