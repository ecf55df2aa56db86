"""One camera for a window: what its points or its frames' cameras agree on."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.errors import DegenerateGeometryError
from laser_slam.types import NO_DISTORTION, Calibration, Window

Array = NDArray[np.float64]
Map = NDArray[np.float32]

MAX_VOTES = 100_000  # pixels that fit the camera: more change nothing
MIN_VOTES = 50
FOCALS = (0.05, 50.0)  # in image sides: from wider to narrower than any lens


def fit_camera(points: Map, confidence: Map, centre: tuple[float, float]) -> Array | None:
    """Find the pinhole camera that sees each point of its maps at the point's own pixel.

    The slopes x / z and y / z grow in proportion to the distance from the centre, for all frames
    alike; the factors, one for each axis, have the least sum of absolute errors over the more
    confident half of the pixels. Two axes, because images were resized by two factors.

    Args:
        points: (N, H, W, 3) in camera axes.
        confidence: (N, H, W) in [0, 1].
        centre: x, y of the principal point in pixels.

    Returns:
        (3, 3) intrinsics in pixels; None: too few pixels are finite, or they have no such factor.
    """
    frames, rows, columns = _voters(points, confidence)
    if len(frames) < MIN_VOTES:
        return None
    voters = points[frames, rows, columns].astype(np.float64)
    trust = confidence[frames, rows, columns].astype(np.float64)
    per_px = [
        _proportion(np.asarray(pixels - middle, np.float64), voters[:, axis] / voters[:, 2], trust)
        for axis, (pixels, middle) in enumerate(zip((columns, rows), centre, strict=True))
    ]
    sides = (confidence.shape[2], confidence.shape[1])
    spans = [slope * side for slope, side in zip(per_px, sides, strict=True)]
    if not all(1 / FOCALS[1] < span < 1 / FOCALS[0] for span in spans):
        return None
    return intrinsics_matrix(1 / per_px[0], 1 / per_px[1], *centre)


def window_camera(intrinsics: Array) -> Array | None:
    """Return the one camera of a window, whose frames a network has given (N, 3, 3) cameras.

    Focal lengths are the medians over frames: all frames of a run come from one lens, so that what
    differs between them is noise, which would bend the window's points frame by frame.
    """
    focals = np.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], axis=1)
    usable = intrinsics[np.isfinite(intrinsics).all(axis=(1, 2)) & (focals > 0).all(axis=1)]
    return np.asarray(np.median(usable, axis=0)) if len(usable) else None


def take_calibration(
    windows: Iterable[Window], intrinsics: Array | None, network: str, *, is_used: bool = False
) -> Calibration:
    """Return the given intrinsics, without distortion, for the size of the windows' images.

    Args:
        windows: of the sequence; the first is looked at.
        intrinsics: (3, 3) in pixels of its images; None: unknown.
        network: its name, for the words.
        is_used: its depth gets the given intrinsics instead of its own.

    Raises:
        DegenerateGeometryError: there is no window.
    """
    window = next(iter(windows), None)
    if window is None:
        raise DegenerateGeometryError("no window to predict")
    height, width = window.images[0].shape[:2]
    origin = "unknown" if intrinsics is None else "given"
    use = "which depth is for" if is_used else f"{network} sees with a camera of its own"
    source = f"{origin}, and taken to be free of distortion; {use}"
    return Calibration(intrinsics, NO_DISTORTION, (height, width), source)


def _voters(points: Map, confidence: Map) -> tuple[NDArray[np.int64], ...]:
    """Return frames, rows and columns of some pixels that fit the camera, evenly spread."""
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(points).all(axis=-1) & (points[..., 2] > 0) & (confidence > 0)
    if not valid.any():
        return (np.zeros(0, np.int64),) * 3
    votes = np.flatnonzero(valid & (confidence >= np.median(confidence[valid])))
    step = -(-len(votes) // MAX_VOTES)
    return np.unravel_index(votes[::step], confidence.shape)


def _proportion(offsets: Array, slopes: Array, trust: Array) -> float:
    """Return g with the least sum of ``trust * |slopes - g * offsets|``: a weighted median."""
    away = np.abs(offsets) >= 1  # the centre itself says nothing
    ratios, weights = slopes[away] / offsets[away], (trust * np.abs(offsets))[away]
    if not len(ratios):
        return float("nan")
    order = np.argsort(ratios)
    reached = np.cumsum(weights[order])
    return float(ratios[order[np.searchsorted(reached, reached[-1] / 2)]])
