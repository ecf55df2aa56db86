"""Windows of a run, read back from disk."""

from __future__ import annotations

from dataclasses import dataclass

from laser_slam.config import Config
from laser_slam.layers import apply_layers
from laser_slam.store import WindowFiles
from laser_slam.types import Image, Layers, Prediction


@dataclass(frozen=True)
class StoredWindow:
    """What a run has on disk of one window.

    Attributes:
        raw: as the backbone predicted it.
        corrected: with the scales of its layers applied; ``raw`` where there are none.
        colors: (N, H, W, 3) RGB.
        layers: None: they were not looked at.
    """

    raw: Prediction
    corrected: Prediction
    colors: Image
    layers: Layers | None


def read_window(files: WindowFiles, index: int, config: Config) -> StoredWindow:
    """Read a window back and apply its layers.

    Raises:
        RunFolderError: a file is missing or damaged.
    """
    raw, colors = files.load(index)
    if not config.has_layers:
        return StoredWindow(raw, raw, colors, None)
    layers = files.load_layers(index)
    return StoredWindow(raw, apply_layers(raw, layers, config.layers), colors, layers)
