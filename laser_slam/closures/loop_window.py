"""A closure measured by the backbone: frames of both ends in one window.

Reference: VGGT-Long (arXiv:2507.16443), loop window. Differs: registration by camera-frame ranges
and anchors, as between neighbouring windows; uncertainties; both sides must fit.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.base import Backbone
from laser_slam.camera import resize_intrinsics
from laser_slam.closures.ends import End, frames_around
from laser_slam.closures.measurement import Measurement
from laser_slam.config import Config
from laser_slam.errors import DegenerateGeometryError
from laser_slam.registration import register
from laser_slam.sim3 import Array, Sim3, cross_matrix
from laser_slam.types import Image, Prediction, Registration, WindowStatus

# A window bends by more than the frames that it shares with another can show: from the middle of
# one to the middle of the next, errors are two to three times the sigmas of their registration.
_BEND = 3.0


def measure_by_window(
    a: End, b: End, backbone: Backbone, intrinsics: Array | None, config: Config
) -> Measurement:
    """Measure the similarity between two windows through a window that holds frames of both.

    Args:
        a: one end.
        b: the other.
        backbone: one that ``sees_far_frames``.
        intrinsics: (3, 3) in pixels of the ends' colours; None: unknown.
        config: of closures and of registration.

    Raises:
        DegenerateGeometryError: the backbone sees nothing, or its window does not fit both ends.
    """
    loop = _predict(a, b, backbone, intrinsics, config.closures.loop_frames)
    sides = [_register(end, loop, config) for end in (a, b)]
    a_from_loop, b_from_loop = (side.previous_from_current for side in sides)
    a_from_b = a_from_loop @ b_from_loop.inverse()
    num = sum(side.num_pixels for side in sides)
    residual = max(side.residual for side in sides)
    covariance = _BEND**2 * _composed(a_from_b, a_from_loop, sides)
    return Measurement(a_from_b, covariance, num, num, residual, "loop window")


def _predict(
    a: End, b: End, backbone: Backbone, intrinsics: Array | None, num_frames: int
) -> Prediction:
    frames, images = _frames_of_both(a, b, num_frames)
    size = images[0].shape[0], images[0].shape[1]
    wanted = backbone.image_size(size)
    if wanted != size:
        images = [np.asarray(cv2.resize(image, wanted[::-1])) for image in images]
        intrinsics = None if intrinsics is None else resize_intrinsics(intrinsics, size, wanted)
    loop = backbone.predict(images, frames, intrinsics)
    if loop.status is not WindowStatus.OK:
        raise DegenerateGeometryError(f"the window of both ends is {loop.status.value}")
    if loop.depth.shape[1:] != a.prediction.depth.shape[1:]:
        raise DegenerateGeometryError(
            f"the window of both ends has depth of {loop.depth.shape[1:]} pixels, "
            f"window {a.window} of {a.prediction.depth.shape[1:]}"
        )
    return loop


def _frames_of_both(a: End, b: End, num_frames: int) -> tuple[NDArray[np.int64], list[Image]]:
    """Return rising frames of both ends, each once, with their images."""
    images: dict[int, Image] = {}
    for end in (a, b):
        for row in frames_around(end, num_frames):
            images.setdefault(int(end.prediction.frames[row]), end.colors[row])
    frames = sorted(images)
    return np.array(frames, dtype=np.int64), [images[frame] for frame in frames]


def _register(end: End, loop: Prediction, config: Config) -> Registration:
    side = register(end.prediction, loop, config.registration)
    if not side.residual <= config.closures.max_residual:
        raise DegenerateGeometryError(
            f"depths of the window of both ends differ from window {end.window} by "
            f"{side.residual:.2f}, at most {config.closures.max_residual:.2f}"
        )
    return side


def _composed(a_from_b: Sim3, a_from_loop: Sim3, sides: list[Registration]) -> Array:
    """Return the (7, 7) covariance of ``a_from_loop @ b_from_loop.inverse()``.

    To first order, with errors as in ``Measurement``: turns and growths subtract, and what they
    do to translations works on the arm from window b's origin to the loop's.
    """
    arm = a_from_loop.translation - a_from_b.translation
    turn = a_from_b.rotation
    by_a, by_b = np.eye(7), np.zeros((7, 7))
    by_b[:3, :3], by_b[6, 6] = -turn, -1.0
    by_b[3:6, 3:6] = -a_from_b.scale * turn
    for slopes in (by_a, by_b):
        slopes[3:6, :3] = cross_matrix(arm) @ slopes[:3, :3]
        slopes[3:6, 6] = -arm * slopes[6, 6]
    parts = zip((by_a, by_b), sides, strict=True)
    return np.asarray(sum((J * side.sigmas**2) @ J.T for J, side in parts))
