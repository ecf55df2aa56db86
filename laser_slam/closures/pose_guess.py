"""A first similarity between two windows: from the points of one and the pixels of the other."""

from __future__ import annotations

import numpy as np
import poselib
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix, poselib_camera
from laser_slam.closures.correspondences import Correspondences, Views
from laser_slam.config import ClosuresConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array, Sim3, orthonormal

MIN_POINTS = 8  # four determine a pose; the rest must agree
_RANSAC = {"max_iterations": 2000, "min_iterations": 100, "success_prob": 0.9999, "seed": 0}
COMMON_WIDTH = 640  # at which the settings count pixels


def guess_similarity(points: Correspondences, config: ClosuresConfig) -> Sim3:
    """Find the similarity that most matches agree on, as both images and both depths see them.

    Each pair of images gives two guesses, a camera of one window among the points of the other,
    for pixels are far more exact than depths; the scale is the ratio of the depths.

    Returns:
        ``a_from_b``.

    Raises:
        DegenerateGeometryError: no pair of images has enough matches with depth.
    """
    guesses: list[Sim3] = []
    for pair in np.unique(points.pair):
        some = points.chosen(points.pair == pair)
        if len(some) < MIN_POINTS:
            continue
        a_from_b = _locate(some.a, some.b, some.width, config)
        b_from_a = _locate(some.b, some.a, some.width, config)
        guesses += [a_from_b] if a_from_b is not None else []
        guesses += [b_from_a.inverse()] if b_from_a is not None else []
    if not guesses:
        raise DegenerateGeometryError(
            f"no pair of images has {MIN_POINTS} matches with depth that agree on a pose"
        )
    return max(guesses, key=lambda guess: float(agreement(points, guess, config).sum()))


def agreement(points: Correspondences, a_from_b: Sim3, config: ClosuresConfig) -> Array:
    """Return (P,) how well each match fits: 1 perfectly, 0 at the limit of an inlier and beyond."""
    limits = inlier_limits(points.width, config)
    to_a = points.a.misfit(a_from_b.apply(points.b.points)) / limits
    to_b = points.b.misfit(a_from_b.inverse().apply(points.a.points)) / limits
    with np.errstate(invalid="ignore"):
        worst = np.maximum(_size(to_a), _size(to_b))
    return np.asarray(1 - np.minimum(worst, 1))


def inlier_limits(width: int, config: ClosuresConfig) -> Array:
    """Return (3,) how large ``Views.misfit`` of an inlier may be."""
    pixels = config.max_error_px * width / COMMON_WIDTH
    return np.array([pixels, pixels, np.log(config.max_depth_ratio)])


def _size(misfits: Array) -> Array:
    """Return (P,) squared misfit in limits, of the pixel or the depth, whichever is worse."""
    return np.asarray(np.maximum((misfits[:, :2] ** 2).sum(axis=1), misfits[:, 2] ** 2))


def _locate(points: Views, seen: Views, width: int, config: ClosuresConfig) -> Sim3 | None:
    """Place the one camera of ``seen`` among points of the other window.

    Returns:
        The similarity from the window of ``seen`` to that of ``points``; None: not found.
    """
    camera = poselib_camera(intrinsics_matrix(*seen.focal[0], *seen.center[0]))
    unit = float(np.median(points.depth))  # thresholds inside must not depend on it
    max_error = config.max_error_px * width / COMMON_WIDTH
    options = {**_RANSAC, "max_reproj_error": max_error}
    pose, info = poselib.estimate_absolute_pose(seen.pixels, points.points / unit, camera, options)
    inliers: NDArray[np.bool_] = np.array(info["inliers"], np.bool_)
    found = np.column_stack([pose.R, pose.t])
    if not np.isfinite(found).all():  # of points in one place
        return None
    rotation, translation = orthonormal(found[:, :3]), unit * found[:, 3]
    depth = (points.points @ rotation.T + translation)[:, 2]
    inliers &= depth > 0
    if inliers.sum() < MIN_POINTS // 2:
        return None
    scale = float(np.exp(np.median(np.log(depth[inliers] / seen.depth[inliers]))))
    cam_from_points = Sim3(1.0, rotation, translation)
    cam_from_window = Sim3.from_matrix(np.vstack([seen.window_from_cam[0], [0, 0, 0, 1]])).inverse()
    return cam_from_points.inverse() @ Sim3(scale) @ cam_from_window
