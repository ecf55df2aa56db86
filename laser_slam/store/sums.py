"""Tiles of a map in the making, on disk while the drive is elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.store.files import atomic_write
from laser_slam.store.tiles import Place, outermost, reading_tile, tile_name


@dataclass(frozen=True)
class TileSums:
    """The voxels of one tile, in the order of first sight.

    Attributes:
        cells: (M, 3) voxels, counted from the tile's corner.
        sums: (M, 10) weight; weight times position in the voxel, times RGB, times unit normal.
        views: (M,) frames that saw the voxel.
    """

    cells: NDArray[np.uint16]
    sums: NDArray[np.float32]
    views: NDArray[np.int32]


class SumFiles:
    """Tiles that are put aside, to be taken up again.

    Args:
        folder: for them alone; whatever is in it is removed.

    Raises:
        RunFolderError: the folder cannot be made or emptied.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.places: set[Place] = set()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._clear()
        except OSError as error:
            raise RunFolderError(
                f"cannot keep map tiles in {folder}: {error.strerror}; choose another folder"
            ) from error

    def save(self, place: Place, tile: TileSums, tile_voxels: int) -> None:
        """Put one tile aside.

        Args:
            place: of the tile among the tiles.
            tile: its voxels.
            tile_voxels: edge of the tile in voxels.

        Raises:
            RunFolderError: the system could not write.
        """
        rim = outermost(tile.cells, tile.views, tile_voxels)
        path = self._folder / tile_name(place)
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **vars(tile), **rim)
        self.places.add(place)

    def load(self, place: Place) -> TileSums:
        """Take one tile up again.

        Raises:
            RunFolderError: the file is missing or damaged.
        """
        with reading_tile(self._folder / tile_name(place)) as file:
            return TileSums(**{field.name: file[field.name] for field in fields(TileSums)})

    def rim(self, place: Place) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
        """Read cells (K, 3) and views (K,) of a tile's outermost voxels.

        Raises:
            RunFolderError: the file is missing or damaged.
        """
        with reading_tile(self._folder / tile_name(place)) as file:
            return file["rim_cells"], file["rim_views"]

    def remove(self) -> None:
        """Remove all of them, and the folder."""
        self._clear()
        self._folder.rmdir()
        self.places.clear()

    def _clear(self) -> None:
        for path in self._folder.iterdir():
            path.unlink()
