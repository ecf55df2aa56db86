"""Rotation and translation between two windows, from the shared frames' cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.registration.scale import FRAMES_ALIKE, Pixels
from laser_slam.sim3 import Sim3, cross_matrix, rotation_log, umeyama

Array = NDArray[np.float64]

# What a good backbone leaves: 0.2 % of the scene's range in the camera centres, and 2 milliradians.
# As a prior worth one frame it keeps a lucky fit of few frames from looking perfect.
POSE_NOISE = 2e-3
_BAD_FRAME = 3.0  # a frame this many medians off loses weight
_ROUNDS = 6
# Axes that anchor a camera, in camera axes: the paper's view and up; ours both ways, so that the
# anchors' mean is the camera centre and errors of the axes do not move it.
_PAPER_AXES = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_ALL_AXES = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True)
class Cameras:
    """The shared frames' cameras in both windows, the current window's centres already scaled.

    Attributes:
        source: (K, 4, 4) ``current_from_cam``, in the previous window's units.
        target: (K, 4, 4) ``previous_from_cam``.
        scene_range: a typical distance to the scene, in the previous window's units.
    """

    source: Array
    target: Array
    scene_range: float


@dataclass(frozen=True)
class Fit:
    """A rigid motion ``previous_from_scaled_current`` and what it left.

    Attributes:
        rigid: scale 1.
        weights: (K,) trust in each shared frame, 1 unless it contradicts the others.
        axes: (A, 3) the anchors' offsets from the camera centre, in camera axes, of full length.
        center_sigma: standard deviation of a camera centre per axis, previous window's units.
        rotation_sigma: of a camera's rotation per axis, in radians.
    """

    rigid: Sim3
    weights: Array
    axes: Array
    center_sigma: float
    rotation_sigma: float


def fit_anchors(cameras: Cameras, anchor_length: str) -> Fit:
    """Fit the anchors (Kabsch), again and again with what the residuals say of the noise."""
    weights = np.ones(len(cameras.source))
    length = cameras.scene_range
    for _round in range(_ROUNDS):
        axes = _axes(cameras, anchor_length, length)
        rigid = _kabsch(_anchors(cameras.source, axes), _anchors(cameras.target, axes), weights)
        fit = judge(cameras, rigid, weights, axes)
        length = fit.center_sigma / fit.rotation_sigma
        weights = fit.weights
    return fit


def _axes(cameras: Cameras, anchor_length: str, balanced_length: float) -> Array:
    if anchor_length == "balanced":
        return balanced_length * _ALL_AXES
    if anchor_length == "unit":
        return _PAPER_AXES
    centers = np.concatenate([centered(cameras.source), centered(cameras.target)])
    spread = float(np.sqrt((centers**2).sum() / len(centers)))
    return max(spread, POSE_NOISE * cameras.scene_range) * _PAPER_AXES


def centered(poses: Array) -> Array:
    """Return the (K, 3) camera centres about their mean."""
    return np.asarray(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0))


def scaled(poses: Array, scale: float) -> Array:
    """Return (K, 4, 4) poses with their centres in another unit."""
    out = np.array(poses)
    out[:, :3, 3] *= scale
    return out


def _kabsch(source: Array, target: Array, weights: Array) -> Sim3:
    """Fit a rigid motion to (K, A, 3) anchors with a weight for each of the K cameras."""
    repeated = np.repeat(weights, source.shape[1])
    return umeyama(source.reshape(-1, 3), target.reshape(-1, 3), with_scale=False, weights=repeated)


def _anchors(poses: Array, axes: Array) -> Array:
    """Return the (K, A, 3) points that stand for K cameras."""
    return np.asarray(poses[:, None, :3, 3] + axes @ np.swapaxes(poses[:, :3, :3], 1, 2))


def judge(cameras: Cameras, rigid: Sim3, weights: Array, axes: Array) -> Fit:
    """Estimate the cameras' noise from what a fit leaves, and each camera's weight in the next."""
    center = cameras.target[:, :3, 3] - rigid.apply(cameras.source[:, :3, 3])
    turned = rigid.rotation @ cameras.source[:, :3, :3]
    turn = rotation_log(cameras.target[:, :3, :3] @ np.swapaxes(turned, 1, 2))
    prior = POSE_NOISE * np.array([cameras.scene_range, 1.0])
    misfits = np.linalg.norm(np.stack([center, turn]), axis=2)  # (2, K)
    freedom = 3 * (max(float(weights.sum()) - 1, 0) + 1)  # the prior counts as one camera
    sigmas = np.sqrt((misfits**2 @ weights + 3 * prior**2) / freedom)
    typical = np.maximum(np.median(misfits, axis=1), prior)
    badness = np.maximum((misfits / typical[:, None]).max(axis=0) / _BAD_FRAME, 1.0)
    return Fit(rigid, badness**-2.0, axes, float(sigmas[0]), float(sigmas[1]))


def fit_points(cameras: Cameras, pixels: Pixels, scale: float, fit: Fit) -> Fit:
    """Fit the scaled points instead of the anchors: the paper's ablation without anchors."""
    source = np.empty_like(pixels.target_cam)
    target = np.empty_like(pixels.target_cam)
    for frame, (source_pose, target_pose) in enumerate(
        zip(cameras.source, cameras.target, strict=True)
    ):
        here = pixels.frame == frame
        source[here] = Sim3.from_matrix(source_pose).apply(scale * pixels.source_cam[here])
        target[here] = Sim3.from_matrix(target_pose).apply(pixels.target_cam[here])
    rigid = umeyama(source, target, with_scale=False)
    return judge(cameras, rigid, np.ones(len(cameras.source)), fit.axes)


def sigmas(cameras: Cameras, fit: Fit, log_scale_sigma: float) -> Array:
    """Carry the noise of the cameras and of the scale over to the 7 degrees of freedom.

    Covariance ``inv(A) B inv(A)`` of the anchors' linear fit, where a camera's anchors move
    together (3 degrees from its centre, 3 from its rotation) and neighbouring cameras err alike.

    Args:
        cameras: what was fitted.
        fit: the result and the noise that it left.
        log_scale_sigma: of the scale, which moves the current window along its lever.

    Returns:
        (7,) as in ``Registration.sigmas``.
    """
    anchors = _anchors(cameras.target, fit.axes)
    motion = np.concatenate(
        [-cross_matrix(anchors), np.broadcast_to(np.eye(3), (*anchors.shape, 3))], -1
    )
    arms = anchors - cameras.target[:, None, :3, 3]
    noise = np.concatenate(
        [np.broadcast_to(np.eye(3), (*arms.shape, 3)), -cross_matrix(arms)], axis=-1
    )
    hessian = np.einsum("k,kaij,kail->jl", fit.weights, motion, motion)
    gain = np.linalg.solve(hessian, np.einsum("k,kaij,kail->kjl", fit.weights, motion, noise))
    sigma = np.repeat([fit.center_sigma, fit.rotation_sigma], 3)
    variances = min(len(cameras.source), FRAMES_ALIKE) * ((gain * sigma) ** 2).sum(axis=(0, 2))
    lever = fit.rigid.rotation @ np.average(cameras.source[:, :3, 3], axis=0, weights=fit.weights)
    variances[3:] += (lever * log_scale_sigma) ** 2
    return np.append(np.sqrt(variances), log_scale_sigma)
