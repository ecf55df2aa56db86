"""The similarity between two windows that share frames, with its uncertainty."""

from __future__ import annotations

import numpy as np

from laser_slam.config import RegistrationConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.registration.cameras import (
    Cameras,
    fit_anchors,
    fit_points,
    judge,
    scaled,
    sigmas,
)
from laser_slam.registration.joint import fit_joint
from laser_slam.registration.scale import SCALE_ESTIMATORS, confident_pixels, log_scale_sigma
from laser_slam.sim3 import Sim3
from laser_slam.types import Prediction, Registration

_RAISE = "raise windows.overlap"


def register(previous: Prediction, current: Prediction, config: RegistrationConfig) -> Registration:
    """Measure the similarity that maps the current window on the previous one.

    Args:
        previous: the window before, or any window that shares frames.
        current: the window to place.
        config: estimators and limits.

    Returns:
        ``previous_from_current`` with its uncertainty.

    Raises:
        DegenerateGeometryError: no shared frame, or too few pixels that both windows trust.
    """
    shared, in_previous, in_current = np.intersect1d(
        previous.frames, current.frames, return_indices=True
    )
    if len(shared) == 0:
        raise DegenerateGeometryError(f"{_name(previous, current)} share no frames; {_RAISE}")
    pixels = confident_pixels(previous, current, in_previous, in_current)
    if pixels.num_shared < config.min_pixels:
        raise DegenerateGeometryError(
            f"{_name(previous, current)} share {pixels.num_shared} confident pixels, "
            f"need {config.min_pixels}; lower registration.min_pixels or {_RAISE}"
        )
    if config.rigid == "joint":
        joint = fit_joint(previous, current, in_previous, in_current, config.huber_delta)
        scale = joint.scale
    else:
        scale = SCALE_ESTIMATORS[config.scale](pixels.source, pixels.target, config)
    residuals = np.log(pixels.target / (scale * pixels.source))
    cameras = Cameras(
        scaled(current.window_from_cam[in_current], scale),
        previous.window_from_cam[in_previous],
        float(np.median(pixels.target)),
    )
    fit = fit_anchors(cameras, config.anchor_length)
    if config.rigid == "points":
        fit = fit_points(cameras, pixels, scale, fit)
    elif config.rigid == "joint":
        rigid = Sim3(1.0, joint.rotation, joint.translation)
        fit = judge(cameras, rigid, np.ones(len(shared)), fit.axes)
    return Registration(
        previous_from_current=Sim3(scale, fit.rigid.rotation, fit.rigid.translation),
        sigmas=sigmas(cameras, fit, log_scale_sigma(residuals, pixels)),
        num_pixels=len(residuals),
        residual=float(np.median(np.abs(residuals))),
    )


def _name(previous: Prediction, current: Prediction) -> str:
    spans = (f"{window.frames[0]}-{window.frames[-1]}" for window in (previous, current))
    return "windows of frames " + " and ".join(spans)
