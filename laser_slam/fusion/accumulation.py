"""Submaps into sums of voxels: tiles that the drive has left wait on disk."""

from __future__ import annotations

import logging
from collections import OrderedDict, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from laser_slam.config import FusionConfig
from laser_slam.fusion.grid import Located, VoxelGrid, Voxels
from laser_slam.fusion.keys import HALF, cells_of, corner_of, keys_of, place_of, tile_of
from laser_slam.fusion.views import View, owned_views
from laser_slam.store import Place, SumFiles, TileSums
from laser_slam.types import Submap

_LOGGER = logging.getLogger(__name__)


class Accumulator:
    """Sums of voxels, a bounded number of them in memory.

    A tile that comes back is read before anything is added to it, so that every sum is made in
    the order of the frames: tiles and their coming and going change no bit of it.

    Attributes:
        windows: whose pixels each tile has, in order.

    Args:
        aside: where tiles wait.
        config: filters, and how many voxels may be in memory.
        voxel_size: edge of a voxel in world units.
        wanted: the tiles that are to be made; None: all.
    """

    def __init__(
        self,
        aside: SumFiles,
        config: FusionConfig,
        voxel_size: float,
        wanted: frozenset[Place] | None = None,
    ) -> None:
        self.windows: dict[Place, list[int]] = defaultdict(list)
        self._aside = aside
        self._config = config
        self._grid = VoxelGrid(voxel_size, config.tile_bits)
        self._wanted = wanted
        self._active: OrderedDict[Place, None] = OrderedDict()  # longest unseen first
        self._num_outside = 0

    def add(self, submap: Submap) -> None:
        """Add the frames that a submap owns.

        Raises:
            RunFolderError: a tile could not be written or read.
        """
        for view in _ahead(owned_views(submap, self._config)):
            located = self._grid.locate(view, self._config.stride)
            self._num_outside += located.num_outside
            places = self._places(located)
            is_wanted = [self._wanted is None or place in self._wanted for place in places]
            touched = [place for place, use in zip(places, is_wanted, strict=True) if use]
            if touched:
                self._activate(touched, submap.index)
                self._grid.add(view, located, np.array(is_wanted))
                self._relieve(len(touched))

    def flush(self) -> None:
        """Put all tiles aside.

        Raises:
            RunFolderError: a tile could not be written.
        """
        self._put_aside(list(self._active))
        if self._num_outside:
            _LOGGER.warning(
                "%d points lie more than %d voxels from the origin and stay out of the cloud; "
                "raise fusion.voxel_size",
                self._num_outside,
                HALF,
            )

    def _places(self, located: Located) -> list[Place]:
        return [place_of(tile, self._config.tile_bits) for tile in located.tiles]

    def _activate(self, places: list[Place], window: int) -> None:
        for place in places:
            if place not in self._active and place in self._aside.places:
                tile = self._aside.load(place)
                keys = keys_of(tile.cells, corner_of(place, self._config.tile_bits))
                self._grid.put(Voxels(keys, tile.sums, tile.views))
            self._active[place] = None
            self._active.move_to_end(place)
            if self.windows[place][-1:] != [window]:
                self.windows[place].append(window)

    def _relieve(self, num_needed: int) -> None:
        """Put the tiles aside that were not seen for longest, until half of the room is free."""
        if self._grid.num_voxels <= self._config.active_voxels:
            return
        counts = self._grid.counts()
        left = self._grid.num_voxels
        gone = []
        for place in list(self._active)[: len(self._active) - num_needed]:
            if left <= self._config.active_voxels // 2:
                break
            gone.append(place)
            left -= counts[tile_of(place, self._config.tile_bits)]
        self._put_aside(gone)

    def _put_aside(self, places: list[Place]) -> None:
        if not places:
            return
        bits = self._config.tile_bits
        tiles = {tile_of(place, bits): place for place in places}
        rising = sorted(tiles)
        for tile, voxels in zip(rising, self._grid.take(np.array(rising)), strict=True):
            place = tiles[tile]
            cells = cells_of(voxels.keys, corner_of(place, bits))
            self._aside.save(place, TileSums(cells, voxels.sums, voxels.views), 1 << bits)
            del self._active[place]


def _ahead(views: Iterator[View]) -> Iterator[View]:
    """Make the next view while one is added: both take about as long, and no lock of Python's."""
    with ThreadPoolExecutor(1, thread_name_prefix="views") as pool:
        upcoming = pool.submit(next, views, None)
        while (view := upcoming.result()) is not None:
            upcoming = pool.submit(next, views, None)
            yield view


def reach(submap: Submap, config: FusionConfig, voxel_size: float) -> set[Place]:
    """Tell which tiles a submap adds to."""
    grid = VoxelGrid(voxel_size, config.tile_bits)
    return {
        place_of(tile, config.tile_bits)
        for view in owned_views(submap, config)
        for tile in grid.locate(view, config.stride).tiles
    }
