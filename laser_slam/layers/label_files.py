"""Layers from label maps that another program wrote."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.config import SegmentationConfig
from laser_slam.errors import ConfigError, DatasetError
from laser_slam.layers.segmenters import close_gaps, known_cells, read_at_cells
from laser_slam.types import Image, Prediction

SUFFIXES = (".png", ".npy")


class LabelFileSegmenter:
    """Read one label map per frame: 000012.png (8 or 16 bit, one channel) or 000012.npy."""

    def __init__(self, config: SegmentationConfig) -> None:
        """Check the folder.

        Raises:
            ConfigError: no folder is set, or it is none.
        """
        if not config.label_folder:
            raise ConfigError(
                "layers.segmentation.label_folder: 'label_files' needs the folder of label maps"
            )
        self._folder = Path(config.label_folder).expanduser()
        if not self._folder.is_dir():
            raise ConfigError(f"layers.segmentation.label_folder: no folder {self._folder}")
        self._downscale = config.downscale

    def segment(self, window: Prediction, colors: Image) -> NDArray[np.uint16]:
        """Label the frames by their files; see ``Segmenter``.

        Every value of a map is a layer, 0 too; only unknown depth has none.

        Raises:
            DatasetError: a label map is missing or is none.
        """
        del colors
        size = (window.depth.shape[1], window.depth.shape[2])
        known = known_cells(window, self._downscale)
        out = np.zeros(known.shape, np.uint16)
        for index, frame in enumerate(window.frames.tolist()):
            cells = read_at_cells(self._read(frame), size, self._downscale).astype(np.int64)
            out[index] = close_gaps(np.where(known[index], cells + 1, 0))
        return out

    def _read(self, frame: int) -> NDArray[np.integer]:
        paths = [self._folder / f"{frame:06d}{suffix}" for suffix in SUFFIXES]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            raise DatasetError(
                f"no label map of frame {frame}: looked for {paths[0].name} and {paths[1].name} "
                f"in {self._folder}; write one per keyframe, or set layers.segmentation.segmenter "
                "to felzenszwalb"
            )
        labels = _load_npy(path) if path.suffix == ".npy" else _load_png(path)
        if labels is None or labels.ndim != 2 or labels.dtype.kind not in "ui" or not labels.size:
            what = "nothing readable" if labels is None else f"{labels.dtype} {labels.shape}"
            raise DatasetError(
                f"{path}: a label map is (H, W) whole numbers in one channel, this is {what}"
            )
        if int(labels.min()) < 0:
            raise DatasetError(f"{path}: labels must not be negative, the least is {labels.min()}")
        return labels


def _load_png(path: Path) -> NDArray[np.integer] | None:
    data = np.fromfile(path, np.uint8)
    labels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    return None if labels is None else np.asarray(labels)


def _load_npy(path: Path) -> NDArray[np.integer] | None:
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (ValueError, EOFError, OSError):
        return None
