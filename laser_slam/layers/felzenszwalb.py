"""Felzenszwalb-Huttenlocher segmentation of depth maps, merged to layers."""

from __future__ import annotations

import math
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.config import SegmentationConfig
from laser_slam.dependencies import num_threads
from laser_slam.layers import felzenszwalb_kernels as kernels
from laser_slam.layers.edge_kernels import NUM_DIRECTIONS, weigh_edges
from laser_slam.layers.merging import merge_regions
from laser_slam.layers.segmenters import MAX_LAYERS, close_gaps
from laser_slam.types import Image, Prediction

Array = NDArray[np.float64]

BLUR_REACH = 4.0  # standard deviations, as scipy and scikit-image cut the Gaussian
SAMPLES = 40_000  # depths of a window that tell its range and its median
ROBUST_RANGE = (2.0, 98.0)  # percentiles


class Workspace:
    """Arrays that one image after the other is segmented in; one thread at a time."""

    def __init__(self, height: int, width: int) -> None:
        num = height * width
        self.size = (height, width)
        self.weights = np.empty((NUM_DIRECTIONS, height, width), np.float32)
        self.spare = np.empty(NUM_DIRECTIONS * num, np.uint64)
        self.edges = np.empty(NUM_DIRECTIONS * num, np.uint64)
        self.parents = np.empty(num, np.uint32)
        self.sizes = np.empty(num, np.uint32)
        self.limits = np.empty(num, np.float64)
        self.offsets = np.array([1, width, width + 1, width - 1], np.uint64)


def partition(
    image: Array, scale: float, sigma: float, min_size: int, workspace: Workspace | None = None
) -> NDArray[np.int32]:
    """Cut an image into regions whose inner differences are small beside those at their borders.

    Args:
        image: (H, W) float64; NaN: unknown, belongs to no region and blurs into none.
        scale: 255 times the k of the paper, in the unit of the image: larger, fewer regions.
        sigma: standard deviation of the blur before, in pixels.
        min_size: smaller regions join the most similar neighbour, pixels.
        workspace: for images of this size; None makes one.

    Returns:
        (H, W) labels from 1 in the order of the regions' first pixels; 0: unknown. Without unknown
        pixels ``skimage.segmentation.felzenszwalb`` gives the same, less one.

    Reference: Felzenszwalb and Huttenlocher, IJCV 2004.
    Differs: edges whose weights agree to 24 bits are taken in the order of the image; regions
    below ``min_size`` also join across unknown pixels, along rows and columns.

    >>> steps = np.repeat([[0.0, 5.0]], 8, axis=0).repeat(8, axis=1)
    >>> partition(steps, scale=1.0, sigma=0.0, min_size=4)[0]
    array([1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2, 2], dtype=int32)
    """
    work = workspace or Workspace(*image.shape)
    blurred = blur(image, sigma)
    weigh_edges(blurred, work.weights)
    edges, forest = (work.edges, work.spare), (work.parents, work.sizes)
    refused = kernels.join_by_weight(
        work.weights, edges, work.offsets, scale / 255, (*forest, work.limits)
    )
    kernels.join_small(work.edges[:refused], work.offsets, min_size, *forest)
    if np.isnan(blurred).any():
        kernels.join_islands(*kernels.gap_edges(blurred, *forest, min_size), min_size, *forest)
    labels = np.empty(image.shape, np.int32)
    kernels.number_regions(blurred, work.parents, work.spare.view(np.int32), labels)
    return labels


def blur(image: Array, sigma: float) -> Array:
    """Blur a (H, W) image with known pixels only; NaN stays NaN and counts for nothing."""
    radius = int(BLUR_REACH * sigma + 0.5)
    if radius == 0:
        return image
    known = np.isfinite(image)
    if known.all():
        return _gaussian(image, radius, sigma)
    share = _gaussian(known.astype(np.float64), radius, sigma)
    blurred = _gaussian(np.where(known, image, 0.0), radius, sigma)
    return np.divide(blurred, share, out=np.full_like(image, np.nan), where=known)


def _gaussian(image: Array, radius: int, sigma: float) -> Array:
    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.GaussianBlur(image, size, sigma, borderType=cv2.BORDER_REFLECT))


class FelzenszwalbSegmenter:
    """Segment each depth map on its own, frames in parallel."""

    def __init__(self, config: SegmentationConfig) -> None:
        self._config = config
        self._local = threading.local()
        self._pool = ThreadPoolExecutor(num_threads(), thread_name_prefix="segmentation")

    def segment(self, window: Prediction, colors: Image) -> NDArray[np.uint16]:
        """Label the frames by depth alone; see ``Segmenter``."""
        del colors
        unit, threshold = self._measure(window)
        maps = self._pool.map(
            lambda depth, confidence: self._segment_frame(depth, confidence, unit, threshold),
            window.depth,
            window.confidence,
        )
        step = self._config.downscale
        out = np.empty_like(window.depth[:, ::step, ::step], dtype=np.uint16, order="C")
        for frame, labels in enumerate(maps):
            out[frame] = labels
        return out

    def _measure(self, window: Prediction) -> tuple[float, float]:
        """Return the window's unit of depth and the threshold of merging, in segmented values."""
        depth, confidence = window.depth, window.confidence
        step = max(1, math.ceil(math.sqrt(depth.size / SAMPLES)))
        some, trusted = depth[:, ::step, ::step], confidence[:, ::step, ::step]
        is_known = (trusted > 0) & np.isfinite(some) & (some > 0)
        if not is_known.any():
            return 1.0, 0.0
        unit = float(np.median(some[is_known].astype(np.float64)))
        if self._config.merge_rule == "range":
            is_confident = (confidence >= np.median(trusted[is_known])) & (depth > 0)
            ends = np.array([depth[is_confident].min(), depth[is_confident].max()])
            low, high = self._values(ends.astype(np.float64), unit)
        else:
            values = self._values(some[is_known].astype(np.float64), unit)
            low, high = np.percentile(values, ROBUST_RANGE)
        return unit, self._config.merge * abs(float(high - low))

    def _values(self, depth: Array, unit: float) -> Array:
        """Return what is segmented: depth on the scale that the settings name."""
        if self._config.depth == "log":
            return np.log(depth / unit)
        return unit / depth if self._config.depth == "inverse" else depth

    def _segment_frame(
        self,
        depth: NDArray[np.float32],
        confidence: NDArray[np.float32],
        unit: float,
        threshold: float,
    ) -> NDArray[np.uint16]:
        config = self._config
        values = self._values(kernels.read_cells(depth, confidence, config.downscale), unit)
        min_size = config.min_share * values.size
        if config.min_size_px:
            min_size = config.min_size_px / config.downscale**2
        work = self._workspace(*values.shape)
        sigma = config.sigma / config.downscale
        labels = partition(values, config.scale, sigma, round(min_size), work)
        labels = merge_regions(labels, values, threshold, config.merge_rule)
        return labels.astype(np.uint16) if labels.max() <= MAX_LAYERS else close_gaps(labels)

    def _workspace(self, height: int, width: int) -> Workspace:
        work: Workspace | None = getattr(self._local, "work", None)
        if work is None or work.size != (height, width):
            work = self._local.work = Workspace(height, width)
        return work
