"""The scale between two windows, from pixels of the shared frames that both trust."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import RegistrationConfig
from laser_slam.types import Prediction

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Neighbouring frames of a window share the errors of one adjustment: so many count as one. True
# errors are then about 0.5 sigma where frames err alone and 2 where errors grow along the window.
FRAMES_ALIKE = 5
_MAX_PIXELS = 40_000  # of all shared frames; a thinner sample moves the scale by about 1e-4
_TILES = (3, 6)  # rows, columns; what one object distorts, it distorts within a tile or so
_HUBER = 1.345  # in standard deviations: 95 % efficient on normal noise
_MAX_MEDIAN = 10_000  # values for the median of a confidence map
_MAX_ROUNDS = 100
_TOLERANCE = 1e-9  # relative
# A frame's scale is off by a few percent in a good window. As a prior worth one frame it keeps
# a single frame, or a lucky agreement of two, from looking certain.
_FRAME_NOISE = 0.02


@dataclass(frozen=True)
class Pixels:
    """Pixels of the shared frames that both windows trust, thinned to ``_MAX_PIXELS``.

    Attributes:
        source_cam: (P, 3) points in camera axes, in the current window's units.
        target_cam: (P, 3) the same pixels' points in the previous window's units.
        source: (P,) range, the distance to the camera centre, in the current window.
        target: (P,) range in the previous window.
        frame: (P,) which of the shared frames.
        tile: (P,) which part of the image.
        num_shared: how many there were before they were thinned.
    """

    source_cam: Array
    target_cam: Array
    source: Array
    target: Array
    frame: Indices
    tile: Indices
    num_shared: int


def confident_pixels(
    previous: Prediction, current: Prediction, in_previous: Indices, in_current: Indices
) -> Pixels:
    """Collect what both windows trust.

    Args:
        previous: the window before.
        current: the window to place; depth maps of the same size.
        in_previous: (K,) where the shared frames are in the previous window.
        in_current: (K,) where they are in the current one.
    """
    limit = -(-_MAX_PIXELS // len(in_previous))
    height, width = previous.depth.shape[1:]
    sources, targets, frames, tiles, num_shared = [], [], [], [], 0
    for frame, (i, j) in enumerate(zip(in_previous, in_current, strict=True)):
        trusted = _trusted(previous, i) & _trusted(current, j)
        chosen = np.flatnonzero(trusted)
        num_shared += len(chosen)
        chosen = chosen[:: -(-len(chosen) // limit) or 1]
        rows, cols = np.divmod(chosen, width)
        targets.append(_points(previous, i, rows, cols))
        sources.append(_points(current, j, rows, cols))
        frames.append(np.full(len(chosen), frame))
        tiles.append(rows * _TILES[0] // height * _TILES[1] + cols * _TILES[1] // width)
    source_cam, target_cam = np.concatenate(sources), np.concatenate(targets)
    return Pixels(
        source_cam,
        target_cam,
        np.sqrt(np.einsum("pi,pi->p", source_cam, source_cam)),
        np.sqrt(np.einsum("pi,pi->p", target_cam, target_cam)),
        np.concatenate(frames),
        np.concatenate(tiles),
        num_shared,
    )


def _trusted(window: Prediction, index: int) -> NDArray[np.bool_]:
    """Return the (H, W) pixels at or above the median confidence of the known ones.

    Differs: the paper says above; stored confidences are quantised, and half of a map may
    share the highest value.
    """
    confidence = window.confidence[index]
    known: NDArray[np.bool_] = confidence > 0
    values = confidence[known]
    if len(values) > 0:
        known &= confidence >= np.median(values[:: len(values) // _MAX_MEDIAN + 1])
    return known


def _points(window: Prediction, index: int, rows: Indices, cols: Indices) -> Array:
    """Return the (P, 3) points of some pixels, in camera axes."""
    K = window.intrinsics[index]
    z = window.depth[index][rows, cols].astype(np.float64)
    return np.stack([(cols - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z], axis=1)


def _log_huber(source: Array, target: Array, _: RegistrationConfig) -> float:
    """Huber on the log-ratio: no unit, no leverage of far pixels; starts from the median."""
    ratios = np.log(target / source)
    center = float(np.median(ratios))
    bend = _HUBER * _spread(ratios - center)
    for _round in range(_MAX_ROUNDS):
        step = float(np.clip(ratios - center, -bend, bend).mean())
        inside = float((np.abs(ratios - center) < bend).mean())
        center += step / max(inside, 0.1)  # Newton on the convex cost
        if abs(step) < _TOLERANCE:
            break
    return float(np.exp(center))


def _huber(source: Array, target: Array, config: RegistrationConfig) -> float:
    """Huber on ``|s * source - target|``, the paper's, run until it converges."""
    bend = config.huber_delta * float(np.median(target))
    scale = float(np.median(target / source))
    for _round in range(_MAX_ROUNDS):
        errors = np.abs(scale * source - target)
        weights = bend / np.maximum(errors, bend)
        last, scale = scale, float((weights * source) @ target / ((weights * source) @ source))
        if abs(scale - last) < _TOLERANCE * scale:
            break
    return scale


def _l1(source: Array, target: Array, _: RegistrationConfig) -> float:
    """Sum of ``|s * source - target|``, the official code's; its minimum is a weighted median."""
    ratios = target / source
    order = np.argsort(ratios)
    mass = np.cumsum(source[order])
    return float(ratios[order[np.searchsorted(mass, 0.5 * mass[-1])]])


def _closed_form(source: Array, target: Array, _: RegistrationConfig) -> float:
    """Least squares, the paper's ablation without IRLS."""
    return float((source @ target) / (source @ source))


# Ranges (P,) in the current and the previous window -> the scale of the current window. With equal
# intrinsics both points of a pixel lie on one ray, so that |s p - q| is the difference of ranges.
SCALE_ESTIMATORS: dict[str, Callable[[Array, Array, RegistrationConfig], float]] = {
    "log_huber": _log_huber,
    "huber": _huber,
    "l1": _l1,
    "closed_form": _closed_form,
}


def _spread(errors: Array) -> float:
    """Return the standard deviation of the inliers of ``errors`` about 0."""
    return max(1.4826 * float(np.median(np.abs(errors))), 1e-9)


def log_scale_sigma(residuals: Array, pixels: Pixels) -> float:
    """Say how far the log-scale may be off.

    Neighbouring pixels err together, hence cluster sums: an image tile (over all frames, which see
    the same objects) counts as one observation, and so does a frame, of which neighbours err
    together as well (``FRAMES_ALIKE``).

    Args:
        residuals: (P,) log-ratios of the ranges, target over scaled source.
        pixels: where they come from.

    Reference: Liang and Zeger, Biometrika 1986 (the sandwich with clusters).
    """
    bend = _HUBER * _spread(residuals)
    bent = np.clip(residuals, -bend, bend)
    steepness = max(float((np.abs(residuals) <= bend).sum()), 1.0)
    variance = 0.0
    for cluster, alike in ((pixels.tile, 1), (pixels.frame, FRAMES_ALIKE)):
        num = int(np.count_nonzero(np.bincount(cluster)))
        sums = np.bincount(cluster, bent) / steepness
        variance += min(num, alike) * (float(sums @ sums) + (_FRAME_NOISE / num) ** 2)
    return float(np.sqrt(variance))
