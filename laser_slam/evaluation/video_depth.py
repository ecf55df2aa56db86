"""Errors of a video's depth after one scale for all of it: the protocol of video-depth tables.

Reference: MonST3R (arXiv:2410.03825) and CUT3R (arXiv:2501.12387), whose evaluation with "scale"
alignment the LASER paper follows. Differs: a pixel without a prediction is not compared, and
counted; a sequence without any compared pixel has no score, where they give it 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.evaluation.depth import is_known

Array = NDArray[np.float64]
Depth = NDArray[np.float32]
DepthPairs = Callable[[], Iterable[tuple[Depth | None, Depth]]]
VideoAlignment = Literal["scale", "metric"]

SCALE_STEPS = 10  # of reweighted least squares, as published
_SMALLEST_RESIDUAL_M = 1e-8  # its weights are 1 / residual
_MEMORY_PIXELS = 64_000_000  # kept between the passes, 8 bytes each; longer videos are read again


@dataclass(frozen=True)
class VideoDepthProtocol:
    """Which pixels of a data set are compared.

    Attributes:
        max_depth_m: pixels whose truth is not below it are not compared; None: all are.
        clip_m: depth is cut off there once it is scaled; None: never.
    """

    max_depth_m: float | None = None
    clip_m: float | None = None


VIDEO_DEPTH_PROTOCOLS: Mapping[str, VideoDepthProtocol] = MappingProxyType(
    {
        "sintel": VideoDepthProtocol(max_depth_m=70.0, clip_m=70.0),  # its sky is beyond
        "bonn": VideoDepthProtocol(max_depth_m=70.0),
        "kitti": VideoDepthProtocol(),  # neither Garg's nor Eigen's crop, and no cap
    }
)


@dataclass(frozen=True)
class VideoDepthErrors:
    """How far a video's depth is from the truth; None: nothing to compare.

    Attributes:
        abs_rel: mean of |depth - truth| / truth over all compared pixels of the video.
        delta_125: share of them whose depth is within a factor 1.25 of the truth, in [0, 1].
        scale: metres per unit of depth that was applied first.
        num_pixels: compared pixels.
        num_true_pixels: pixels with truth below the cap, compared or not: the weight of this video
            in a mean over videos, so that no method makes the videos count less that it fails on.
        num_frames: frames with truth.
        num_predicted: those of them that have any depth.
        coverage: share of the pixels with truth below the cap that were compared; None: none is.
        reason: why nothing is scored; None: it is.
    """

    abs_rel: float | None = None
    delta_125: float | None = None
    scale: float | None = None
    num_pixels: int = 0
    num_true_pixels: int = 0
    num_frames: int = 0
    num_predicted: int = 0
    coverage: float | None = None
    reason: str | None = None


def evaluate_video_depth(
    pairs: DepthPairs, protocol: VideoDepthProtocol, alignment: VideoAlignment = "scale"
) -> VideoDepthErrors:
    """Compare a video's depth with the truth after one scale for all its frames.

    The scale minimises the sum of |scale * depth - truth|: ten steps of reweighted least squares
    from the ratio of the means. Their sums need one frame at a time, so that a video of any length
    is scored exactly: where its pixels are too many to keep, it is read once for each step.

    Args:
        pairs: starts to read the video: for each frame the depth (h, w) in any unit, or None
            where there is none, and the truth (H, W) in metres. Not finite or not positive:
            unknown. Depth of another size is resized to the truth.
        protocol: which pixels are compared.
        alignment: ``scale``: as above; ``metric``: depth is in metres already.
    """
    pixels = _ComparedPixels(pairs, protocol.max_depth_m)
    counted = VideoDepthErrors(
        num_pixels=pixels.num,
        num_true_pixels=pixels.num_true,
        num_frames=pixels.num_frames,
        num_predicted=pixels.num_predicted,
        coverage=pixels.num / pixels.num_true if pixels.num_true else None,
    )
    if not pixels.num:
        reason = "no pixel has both depth and truth" if pixels.num_true else "no pixel has truth"
        return replace(counted, reason=reason)
    scale = _scale(pixels) if alignment == "scale" else 1.0
    ceiling = np.inf if protocol.clip_m is None else protocol.clip_m
    sums = np.zeros(2)
    for found, true in pixels:
        sums += _error_sums(np.minimum(scale * found, ceiling), true)
    abs_rel, delta_125 = (sums / pixels.num).tolist()
    return replace(counted, abs_rel=abs_rel, delta_125=delta_125, scale=scale)


def resize_depth(depth: Depth, size: tuple[int, int]) -> Depth:
    """Resize (h, w) depth to (height, width), cubic as the protocol wants it.

    Where a cubic mixes with unknown pixels or falls to zero, the nearest pixel is taken instead.
    """
    if depth.shape == size:
        return depth
    source = depth.astype(np.float32, copy=False)  # from half precision, which OpenCV lacks
    cubic = cv2.resize(source, size[::-1], interpolation=cv2.INTER_CUBIC)
    nearest = cv2.resize(source, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(np.where(is_known(cubic), cubic, nearest), dtype=np.float32)


class _ComparedPixels:
    """A video's pixels with depth and truth, frame by frame, as often as asked."""

    def __init__(self, pairs: DepthPairs, max_depth_m: float | None) -> None:
        """Read the video once to count its pixels, and keep them where they are few."""
        self._pairs = pairs
        self._ceiling = np.inf if max_depth_m is None else max_depth_m
        self._kept: list[tuple[Depth, Depth]] | None = []
        self.num = self.num_true = self.num_frames = self.num_predicted = 0
        for found, true, num_true in self._read():
            self.num_frames += num_true > 0
            self.num_predicted += len(true) > 0
            self.num_true += num_true
            self.num += len(true)
            if self.num > _MEMORY_PIXELS:
                self._kept = None
            if self._kept is not None:
                self._kept.append((found, true))

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        """Give the depth and the truth of each frame's pixels, (M,) each."""
        again = ((found, true) for found, true, _ in self._read())
        for found, true in again if self._kept is None else self._kept:
            yield found.astype(np.float64), true.astype(np.float64)

    def _read(self) -> Iterator[tuple[Depth, Depth, int]]:
        for depth, truth in self._pairs():
            has_truth = is_known(truth) & (truth < self._ceiling)
            if depth is None:
                yield np.empty(0, np.float32), np.empty(0, np.float32), int(has_truth.sum())
                continue
            found = resize_depth(depth, (truth.shape[0], truth.shape[1]))
            compared = has_truth & is_known(found)
            yield found[compared], truth[compared], int(has_truth.sum())


def _scale(pixels: _ComparedPixels) -> float:
    """Return the scale with the least sum of absolute errors, by reweighted least squares."""
    sums = np.zeros(2)
    for found, true in pixels:
        sums += (true.sum(), found.sum())
    scale = float(sums[0] / sums[1])
    for _ in range(SCALE_STEPS):
        sums = np.zeros(2)
        for found, true in pixels:
            weighted = found / (np.abs(scale * found - true) + _SMALLEST_RESIDUAL_M)
            sums += (weighted @ true, weighted @ found)
        scale = float(sums[0] / sums[1])
    return scale


def _error_sums(found: Array, true: Array) -> tuple[float, float]:
    """Return the sum of the relative errors and the number of pixels within a factor 1.25."""
    within = np.maximum(found / true, true / found) < 1.25
    return float((np.abs(found - true) / true).sum()), float(within.sum())
