"""Segmenters: the depth maps of one window to layers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from laser_slam.dependencies import import_named
from laser_slam.errors import ConfigError
from laser_slam.types import Image, Prediction

if TYPE_CHECKING:
    from laser_slam.config import SegmentationConfig

SEGMENTERS = {
    "felzenszwalb": "laser_slam.layers.felzenszwalb:FelzenszwalbSegmenter",
    "label_files": "laser_slam.layers.label_files:LabelFileSegmenter",
    "sam2": "laser_slam.layers.sam2:Sam2Segmenter",
}
MAX_LAYERS = int(np.iinfo(np.uint16).max)


class Segmenter(Protocol):
    """Cuts depth maps into layers: surfaces at about one depth."""

    def segment(self, window: Prediction, colors: Image) -> NDArray[np.uint16]:
        """Label the frames of one window.

        Args:
            window: its depth decides what is unknown.
            colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.

        Returns:
            (N, ceil(H / f), ceil(W / f)) labels, where f is the setting ``downscale``: in each
            frame from 1 without gaps; 0: depth unknown. Cell (i, j) stands for the f x f block
            of pixels that starts at (i f, j f).
        """
        ...


def make_segmenter(config: SegmentationConfig) -> Segmenter:
    """Import and build the segmenter that the settings name.

    Raises:
        ConfigError: no segmenter has this name.
    """
    setting = "layers.segmentation.segmenter"
    segmenter: Segmenter = import_named(SEGMENTERS, config.segmenter, setting)(config)
    return segmenter


def close_gaps(labels: NDArray[np.integer]) -> NDArray[np.uint16]:
    """Number (h, w) labels from 1 without gaps, in their order; 0 stays 0.

    Raises:
        ConfigError: more layers than 16 bits can count.

    >>> close_gaps(np.array([[0, 7], [300, 7]]))
    array([[0, 1],
           [2, 1]], dtype=uint16)
    """
    old, places = np.unique(np.append(labels.ravel(), 0), return_inverse=True)
    if len(old) - 1 > MAX_LAYERS:
        raise ConfigError(
            f"a frame falls into {len(old) - 1} layers, at most {MAX_LAYERS} can be: "
            "raise layers.segmentation.min_share or downscale, or use label maps with fewer labels"
        )
    return places[:-1].reshape(labels.shape).astype(np.uint16)


def known_cells(window: Prediction, downscale: int) -> NDArray[np.bool_]:
    """Return (N, h, w) True where a cell has a pixel of positive, finite, confident depth."""
    depth = window.depth
    is_known = (window.confidence > 0) & (depth > 0) & (depth < np.inf)
    for axis in (1, 2):
        starts = np.arange(0, depth.shape[axis], downscale)
        is_known = np.logical_or.reduceat(is_known, starts, axis=axis)
    return is_known


def read_at_cells(
    labels: NDArray[np.integer], size: tuple[int, int], downscale: int
) -> NDArray[np.integer]:
    """Read a label map of any size at the middle of the cells of a (height, width) depth map.

    >>> read_at_cells(np.array([[1, 2], [3, 4]]), (4, 4), 1)[0]
    array([1, 1, 2, 2])
    """
    rows, columns = (
        _middles(pixels, downscale, places)
        for pixels, places in zip(size, labels.shape, strict=True)
    )
    return np.asarray(labels[np.ix_(rows, columns)])


def _middles(pixels: int, downscale: int, places: int) -> NDArray[np.int64]:
    starts = np.arange(0, pixels, downscale)
    middles = (starts + np.minimum(starts + downscale, pixels)) / 2
    return (middles * places / pixels).astype(np.int64)
