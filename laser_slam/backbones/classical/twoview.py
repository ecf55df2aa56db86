"""Two views: the rotation between them, their parallax, and the pair to start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from laser_slam.backbones.classical.tracking import FrameTracks
from laser_slam.camera import poselib_camera
from laser_slam.sim3 import Array, orthonormal

GAPS = (2, 3, 4, 6, 8, 12)  # frames between the two views of a starting pair
ENOUGH_PARALLAX_PX = 12.0
ENOUGH_MATCHES = 200
MIN_PARALLAX_PX = 2.0  # at full width of 1280; less is the noise of the tracks
MIN_MATCHES = 30


@dataclass(frozen=True)
class Motion:
    """What moved between two frames.

    Attributes:
        num_matches: tracks that both frames see.
        flow_px: median length of the flow.
        parallax_px: 60th percentile of the flow that no rotation explains.
        second_from_first: (3, 3) the rotation that explains most of it.
    """

    num_matches: int
    flow_px: float
    parallax_px: float
    second_from_first: Array


def bearings(pixels: Array, intrinsics: Array) -> Array:
    """Return (N, 3) unit directions in camera axes of (N, 2) pixels."""
    x = (pixels[:, 0] - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (pixels[:, 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    rays = np.stack([x, y, np.ones(len(x))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def match(first: FrameTracks, second: FrameTracks) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the (N, 2) pixels of the tracks that two frames share, and their ids."""
    ids, i, j = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    return first.pixels[i], second.pixels[j], ids


def measure_motion(first: FrameTracks, second: FrameTracks, intrinsics: Array) -> Motion:
    """Separate the flow between two frames into rotation and parallax."""
    a, b, _ = match(first, second)
    if len(a) < MIN_MATCHES:
        return Motion(len(a), 0.0, 0.0, np.eye(3))
    rays_a, rays_b = bearings(a, intrinsics), bearings(b, intrinsics)
    rotation = fit_rotation(rays_a, rays_b)
    rest = np.linalg.norm(rays_a @ rotation.T - rays_b, axis=1) * intrinsics[0, 0]
    flow = float(np.median(np.linalg.norm(a - b, axis=1)))
    return Motion(len(a), flow, float(np.percentile(rest, 60)), rotation)


def fit_rotation(source: Array, target: Array, iterations: int = 6) -> Array:
    """Fit the (3, 3) target_from_source rotation of (N, 3) directions by reweighted Kabsch."""
    weights = np.ones(len(source))
    rotation = np.eye(3)
    for _ in range(iterations):
        rotation = orthonormal((target * weights[:, None]).T @ source)
        error = np.linalg.norm(source @ rotation.T - target, axis=1)
        weights = 1.0 / np.maximum(error, 1e-4)
    return rotation


def choose_pair(views: list[FrameTracks], intrinsics: Array) -> tuple[int, int] | None:
    """Choose the two views to start from: much parallax and many matches; None: nothing moves."""
    least = MIN_PARALLAX_PX * views[0].grey.shape[1] / 1280
    starts = sorted({0, len(views) // 3, len(views) // 2})
    pairs = [(s, s + gap) for s in starts for gap in GAPS if s + gap < len(views)]
    best, best_score = None, 0.0
    for i, j in pairs:
        motion = measure_motion(views[i], views[j], intrinsics)
        share = min(motion.num_matches, ENOUGH_MATCHES) / ENOUGH_MATCHES
        score = min(motion.parallax_px, ENOUGH_PARALLAX_PX) * np.sqrt(share)
        if motion.parallax_px >= least and score > best_score:
            best, best_score = (i, j), score
    return best


def relative_pose(
    first: FrameTracks, second: FrameTracks, intrinsics: Array, max_error_px: float
) -> tuple[Array, Array, int]:
    """Estimate second_from_first by RANSAC on the essential matrix.

    Returns:
        (3, 3) rotation, (3,) unit translation, number of inliers.
    """
    a, b, _ = match(first, second)
    camera = poselib_camera(intrinsics)
    options = {"max_epipolar_error": max_error_px, "seed": 0, "max_iterations": 2000}
    pose, info = poselib.estimate_relative_pose(a, b, camera, camera, options, {})
    translation = np.asarray(pose.t, dtype=np.float64)
    length = max(float(np.linalg.norm(translation)), 1e-12)
    return np.asarray(pose.R), translation / length, int(info["num_inliers"])


def absolute_pose(
    pixels: Array, points: Array, intrinsics: Array, max_error_px: float
) -> tuple[Array, Array, int]:
    """Estimate cam_from_window from (N, 2) pixels of (N, 3) points by RANSAC.

    Returns:
        (3, 3) rotation, (3,) translation, number of inliers; with none, the pose is NaN.
    """
    options = {"max_reproj_error": max_error_px, "seed": 0, "max_iterations": 1000}
    pose, info = poselib.estimate_absolute_pose(
        pixels, points, poselib_camera(intrinsics), options, {}
    )
    return np.asarray(pose.R), np.asarray(pose.t), int(info["num_inliers"])
