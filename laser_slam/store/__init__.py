"""Files of the run folder."""

from laser_slam.store.files import atomic_write, write_text
from laser_slam.store.run import (
    link_latest,
    name_differences,
    new_run_folder,
    open_run_folder,
)
from laser_slam.store.sums import SumFiles, TileSums
from laser_slam.store.tiles import Place, Tile, TileEntry, TileFiles, TileIndex
from laser_slam.store.windows import (
    FORMAT_VERSION,
    WindowFiles,
    load_layers,
    load_prediction,
    pack_window,
    save_layers,
    save_prediction,
)

__all__ = [
    "FORMAT_VERSION",
    "Place",
    "SumFiles",
    "Tile",
    "TileEntry",
    "TileFiles",
    "TileIndex",
    "TileSums",
    "WindowFiles",
    "atomic_write",
    "link_latest",
    "load_layers",
    "load_prediction",
    "name_differences",
    "new_run_folder",
    "open_run_folder",
    "pack_window",
    "save_layers",
    "save_prediction",
    "write_text",
]
