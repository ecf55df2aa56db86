"""A guess where the scale between two windows cannot be measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.registration.cameras import POSE_NOISE, Cameras, centered, fit_anchors, scaled
from laser_slam.sim3 import Sim3, orthonormal
from laser_slam.types import Prediction, Registration, WindowStatus

Indices = NDArray[np.int64]


def bridge(previous: Prediction, current: Prediction, reason: str) -> Registration:
    """Guess where the current window lies, when its scale cannot be measured.

    Shared frames give rotation and translation. The scale is the ratio of the camera paths where
    both windows moved, else 1: windows are normalised to a median depth of about 1.
    Without a shared frame the current window starts where the previous one ends.

    Args:
        previous: the window before.
        current: the window to place; any status.
        reason: why this is a guess, in words for the report.
    """
    shared, in_previous, in_current = np.intersect1d(
        previous.frames, current.frames, return_indices=True
    )
    reach = _typical_depth(previous)
    if len(shared) == 0:
        end, start = previous.window_from_cam[-1], current.window_from_cam[0]
        rotation = orthonormal(end[:3, :3] @ start[:3, :3].T)
        guess = Sim3(1.0, rotation, end[:3, 3] - rotation @ start[:3, 3])
        spreads = [0.5, 2 * reach, 0.7]
    else:
        source = current.window_from_cam[in_current]
        scale, scale_sigma = _scale_of_paths(previous, current, in_previous, in_current)
        target = previous.window_from_cam[in_previous]
        cameras = Cameras(scaled(source, scale), target, reach)
        rigid = fit_anchors(cameras, "balanced").rigid
        guess = Sim3(scale, rigid.rotation, rigid.translation)
        spreads = [0.1, 0.5 * reach, scale_sigma]
    return Registration(guess, np.repeat(spreads, [3, 3, 1]), 0, float("nan"), bridged=reason)


def _typical_depth(window: Prediction) -> float:
    known = window.depth[window.confidence > 0]
    return float(np.median(known)) if len(known) else 1.0


def _scale_of_paths(
    previous: Prediction, current: Prediction, in_previous: Indices, in_current: Indices
) -> tuple[float, float]:
    """Return scale and sigma of log-scale from the camera paths; 1 and wide without two paths."""
    lengths = []
    for window, chosen in ((previous, in_previous), (current, in_current)):
        length = float(np.linalg.norm(centered(window.window_from_cam[chosen])))
        moved = length > 5 * POSE_NOISE * _typical_depth(window)
        if window.status is not WindowStatus.OK or not moved:
            return 1.0, 0.5
        lengths.append(length)
    return lengths[0] / lengths[1], 0.1
