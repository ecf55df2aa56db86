"""The map of a run: from its stored windows, at their final places."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from laser_slam.config import Config
from laser_slam.fusion import Part, TiledMap, Watch
from laser_slam.sim3 import Sim3
from laser_slam.slam import StoredWindow
from laser_slam.store import TileFiles, WindowFiles
from laser_slam.store.keyframes import Keyframes
from laser_slam.types import Submap

TILES = "tiles"  # folder of a run
DECIMALS = 9


def fuse_run(
    folder: Path,
    keyframes: Keyframes,
    config: Config,
    load: Callable[[int], StoredWindow],
    watch: Watch | None = None,
    see: Callable[[Submap], None] | None = None,
) -> TileFiles:
    """Make a run's map in ``folder/tiles``, or mend the one that is there.

    Only windows whose place, layers or prediction changed since, and those that share tiles with
    them, are read.

    Args:
        folder: of the run.
        keyframes: at their final places.
        config: of the run.
        load: reads a window back, its layers applied.
        watch: is told how many windows are done, and of how many.
        see: is shown each window that is read, some of them more than once.

    Returns:
        The map; ``num_points`` is 0 where nothing was seen with confidence.

    Raises:
        RunFolderError: windows or tiles cannot be read or written.
    """
    files = WindowFiles(folder)
    layers = config.layers.model_dump_json() if config.has_layers else ""
    parts = [
        Part(index, _fingerprint(keyframes, index, files.stamp(index) + layers))
        for index in np.unique(keyframes.windows).tolist()
    ]

    def placed(index: int) -> Submap:
        submap = place_window(keyframes, index, load(index))
        if see is not None:
            see(submap)
        return submap

    tiles = TileFiles(folder / TILES)
    TiledMap(tiles, config.fusion).update(parts, placed, watch)
    return tiles


def place_window(keyframes: Keyframes, index: int, window: StoredWindow) -> Submap:
    """Join a window with the places of the frames that it owns.

    Args:
        keyframes: of the run.
        index: of the window.
        window: its depth and colours.
    """
    rows = np.flatnonzero(keyframes.windows == index)
    frames = window.corrected.frames
    owned = np.searchsorted(frames, keyframes.frames[rows])
    places = [Sim3.from_matrix(keyframes.world_from_window[row]) for row in rows]
    of_frames = [places[0]] * len(frames)
    for i, place in zip(owned, places, strict=True):
        of_frames[i] = place
    is_owned = np.isin(frames, keyframes.frames[rows])
    return Submap(
        index, window.corrected, window.colors, places[0], is_owned, None, tuple(of_frames)
    )


def _fingerprint(keyframes: Keyframes, index: int, stamp: str) -> str:
    """Sum up all that a window's part of the map depends on.

    Places count to nine decimals, for sums over threads are not quite the same each time.
    """
    is_of = keyframes.windows == index
    digest = hashlib.blake2b(stamp.encode(), digest_size=16)
    digest.update(keyframes.frames[is_of].tobytes())
    for places in (keyframes.world_from_window[is_of], keyframes.world_from_cam[is_of]):
        digest.update((places.round(DECIMALS) + 0.0).tobytes())  # no -0
    return digest.hexdigest()
