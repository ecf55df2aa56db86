"""The finished map on disk: one file per tile, an index beside them."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.store.files import atomic_write, write_text
from laser_slam.types import Cloud

TILES_VERSION = 1
_INDEX = "index.json"
_STEPS = 1 << 16  # of a position inside its voxel
_DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)

Place = tuple[int, int, int]


@dataclass(frozen=True)
class Tile:
    """The finished voxels of one tile, with those that have too little support.

    These are no points of the map, but they may become so when a neighbouring tile changes.

    Attributes:
        corner: (3,) the voxel at the tile's lowest corner, counted from the world's origin.
        cells: (M, 3) voxels, counted from the corner.
        offsets: (M, 3) mean position inside each voxel, in 65536ths of its edge.
        colors: (M, 3) RGB.
        normals: (M, 3) unit normals times 127, towards the cameras.
        weights: (M,) summed confidence.
        views: (M,) frames that saw the voxel.
        is_kept: (M,) True where voxel and neighbours were seen often enough: a point of the map.
    """

    corner: NDArray[np.int64]
    cells: NDArray[np.uint16]
    offsets: NDArray[np.uint16]
    colors: NDArray[np.uint8]
    normals: NDArray[np.int8]
    weights: NDArray[np.float32]
    views: NDArray[np.uint16]
    is_kept: NDArray[np.bool_]

    def cloud(self, voxel_size: float, step: int = 1) -> Cloud:
        """Return every ``step``-th point of the map in world units."""
        rows = np.flatnonzero(self.is_kept)[::step]
        inside = (self.offsets[rows] + 0.5) / _STEPS
        points = (self.corner + self.cells[rows] + inside) * voxel_size
        return Cloud(
            points, self.colors[rows], self.weights[rows], voxel_size, _unit(self.normals[rows])
        )


def _unit(normals: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return unit vectors; a voxel that was seen from opposite sides alike gets any."""
    out = normals.astype(np.float32)
    lengths = np.linalg.norm(out, axis=1, keepdims=True)
    out[lengths[:, 0] == 0] = (0, 0, -1)
    return np.asarray(out / np.maximum(lengths, 1), np.float32)


@dataclass(frozen=True)
class TileEntry:
    """What the index says of a tile.

    Attributes:
        place: of the tile among the tiles.
        num_points: of the map.
        num_voxels: with those that have too little support.
        windows: whose pixels went into it, rising.
    """

    place: Place
    num_points: int
    num_voxels: int
    windows: tuple[int, ...]


@dataclass(frozen=True)
class TileIndex:
    """What is in the folder.

    Attributes:
        voxel_size: edge of a voxel in world units.
        settings: that the tiles were made with, plain JSON values.
        windows: fingerprint of each window that went in, by its index.
        tiles: in a fixed order.
    """

    voxel_size: float
    settings: Mapping[str, Any]
    windows: Mapping[int, str]
    tiles: Sequence[TileEntry]


class TileFiles:
    """The map of a finished run, tile by tile.

    Args:
        folder: of the tiles, ``RUN/tiles``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def num_points(self) -> int:
        """Return how many points the map has.

        Raises:
            RunFolderError: no finished map is there.
        """
        return sum(entry.num_points for entry in self.index().tiles)

    @property
    def voxel_size(self) -> float:
        """Return the edge of the voxels in world units; 0: nothing was seen.

        Raises:
            RunFolderError: no finished map is there.
        """
        return self.index().voxel_size

    def clouds(self, step: int = 1) -> Iterator[Cloud]:
        """Read the map, one tile at a time, in a fixed order.

        Args:
            step: every so many-th point only.

        Raises:
            RunFolderError: no finished map is there, or a file is damaged.
        """
        index = self.index()
        for entry in index.tiles:
            if entry.num_points:
                yield self.load(entry.place).cloud(index.voxel_size, step)

    def cloud(self, most: int) -> Cloud:
        """Return the whole map where it has at most ``most`` points, else an even part of it.

        Raises:
            RunFolderError: no finished map is there, or a file is damaged.
        """
        index = self.index()
        step = max(1, -(-sum(entry.num_points for entry in index.tiles) // most))
        num = sum(-(-entry.num_points // step) for entry in index.tiles)
        whole = Cloud(  # filled part by part: joining them would take twice the memory
            np.zeros((num, 3)),
            np.empty((num, 3), np.uint8),
            np.empty(num, np.float32),
            index.voxel_size,
            np.empty((num, 3), np.float32),
        )
        start = 0
        for part in self.clouds(step):
            rows = slice(start, start + len(part.points))
            for name in ("points", "colors", "weights", "normals"):
                getattr(whole, name)[rows] = getattr(part, name)
            start = rows.stop
        return whole

    def index(self) -> TileIndex:
        """Read the index.

        Raises:
            RunFolderError: no finished map is there, or it is damaged or of another version.
        """
        path = self.folder / _INDEX
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            version = stored.pop("version")
            if version == TILES_VERSION:
                return _index_of(stored)
        except FileNotFoundError as error:
            raise RunFolderError(
                f"no finished map in {self.folder}; give the folder of a finished run"
            ) from error
        except (*_DAMAGE, AttributeError) as error:
            raise RunFolderError(f"{path} is damaged; run again") from error
        raise RunFolderError(
            f"{path} has format {version}, this laser-slam reads {TILES_VERSION}; run again"
        )

    def load(self, place: Place) -> Tile:
        """Read one tile.

        Raises:
            RunFolderError: the file is missing or damaged.
        """
        with reading_tile(self._path(place)) as file:
            return Tile(**{field.name: file[field.name] for field in fields(Tile)})

    def save(self, place: Place, tile: Tile, tile_voxels: int) -> None:
        """Write one tile.

        Args:
            place: of the tile among the tiles.
            tile: its voxels.
            tile_voxels: edge of the tile in voxels.

        Raises:
            RunFolderError: the system could not write.
        """
        rim = outermost(tile.cells, tile.views, tile_voxels)
        with atomic_write(self._path(place)) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **vars(tile), **rim)

    def rim(self, place: Place) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Read cells (K, 3) and views (K,) of a tile's outermost voxels, supported or not.

        Raises:
            RunFolderError: the file is missing or damaged.
        """
        with reading_tile(self._path(place)) as file:
            return file["rim_cells"], file["rim_views"]

    def open(self, kept: Iterable[Place]) -> None:
        """Begin to change the map: until the index is saved again, none is there.

        Args:
            kept: the tiles that stay; all others are removed.

        Raises:
            RunFolderError: the folder cannot be made or changed.
        """
        names = {tile_name(place) for place in kept}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / _INDEX).unlink(missing_ok=True)
            for path in self.folder.glob("*.npz"):
                if path.name not in names:
                    path.unlink()
        except OSError as error:
            raise RunFolderError(
                f"cannot keep map tiles in {self.folder}: {error.strerror}; choose another folder"
            ) from error

    def save_index(self, index: TileIndex) -> None:
        """Write the index: from here on, the map is finished.

        Raises:
            RunFolderError: the system could not write.
        """
        text = json.dumps({"version": TILES_VERSION, **asdict(index)})
        write_text(self.folder / _INDEX, text + "\n")

    def _path(self, place: Place) -> Path:
        return self.folder / tile_name(place)


def tile_name(place: Place) -> str:
    """Return the name of a tile's file."""
    return "_".join(f"{part:d}" for part in place) + ".npz"


def outermost(
    cells: NDArray[np.uint16], views: NDArray[Any], tile_voxels: int
) -> dict[str, NDArray[Any]]:
    """Pick the voxels at a tile's faces, for its neighbours: they need not read the whole tile."""
    is_outermost = ((cells == 0) | (cells == tile_voxels - 1)).any(axis=1)
    return {"rim_cells": cells[is_outermost], "rim_views": views[is_outermost]}


@contextmanager
def reading_tile(path: Path) -> Iterator[Any]:
    """Open a tile; say of what is wrong with it that it is this file, and what to do."""
    try:
        with np.load(path, allow_pickle=False) as file:
            yield file
    except _DAMAGE as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise RunFolderError(f"cannot read map tile {path}: {text}; run again") from error


def _index_of(stored: dict[str, Any]) -> TileIndex:
    entries = [
        TileEntry(
            tuple(entry["place"]),
            entry["num_points"],
            entry["num_voxels"],
            tuple(entry["windows"]),
        )
        for entry in stored["tiles"]
    ]
    windows = {int(index): str(value) for index, value in stored["windows"].items()}
    return TileIndex(float(stored["voxel_size"]), stored["settings"], windows, entries)
