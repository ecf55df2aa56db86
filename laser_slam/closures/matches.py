"""A closure measured by matched pixels that have depth in both windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.closures.correspondences import Correspondences, correspond
from laser_slam.closures.ends import End, PairMatches
from laser_slam.closures.measurement import Measurement, moved_by
from laser_slam.closures.pose_guess import COMMON_WIDTH, agreement, guess_similarity
from laser_slam.config import ClosuresConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array, Sim3, cross_matrix, rotation_exp

_ROUNDS = 15
_RANK = 1e-12  # of the largest eigenvalue; what is less sure than that is left as guessed
_CONVERGED = 1e-6  # radians, median depths, log
_PIXEL_NOISE = 0.5  # of a match, per axis and image, px at 640 wide; at least
_DEPTH_NOISE = 0.005  # of a depth, log; at least
_DEPTH_GROUPS = 4  # by depth: far ones err more
_REDESCEND = 25.0  # squared misfit, of 3 numbers in sigmas, from which a match has no say
# What a pair of windows may be off as a whole, however well the matches agree: the pose of a frame
# within its window (radians, median depths), and the unit of its depth (log) where depths are as
# uneven as those of networks; even ones have a surer unit.
_TURN, _MOVE, _GROWTH = 2e-3, 3e-3, 0.02
_NETWORK_NOISE = 0.06  # of the log-ratio of two depths
_PAIRS_ALIKE = 5  # neighbouring pairs of images share the errors of their windows
# Cells of direction and log depth, seen from the matched frame: what one object distorts.
_CELLS = np.array([0.25, 0.25, 0.4])


@dataclass(frozen=True)
class _Noise:
    """Standard deviations: of a pixel per axis, and (P,) of the log-ratio of two depths."""

    pixel: float
    ratio: Array


def measure_by_matches(
    a: End, b: End, pairs: Sequence[PairMatches], config: ClosuresConfig
) -> Measurement:
    """Measure the similarity between two windows from pixels that show the same points.

    All pairs of images are fitted at once, for all are posed in their windows. A match counts with
    what its pixels and its depths say, each as exact as the residuals show it to be, farther
    depths less; what the depth of one end blurs in the image of the other is taken into account.

    Args:
        a: one end.
        b: the other.
        pairs: matched pixels of frames of both; some may be wrong.
        config: limits.

    Raises:
        DegenerateGeometryError: too few matches have depth, or too few agree.
    """
    points = correspond(a, b, pairs)
    if len(points) < config.min_inliers:
        raise DegenerateGeometryError(
            f"{len(points)} of {points.total} matches have depth at both ends, "
            f"need {config.min_inliers}"
        )
    guess = guess_similarity(points, config)
    a_from_b, noise = _refine(points, guess, config)
    is_inlier = agreement(points, a_from_b, config) > 0
    num = int(is_inlier.sum())
    if num < config.min_inliers or num < config.min_inlier_share * len(points):
        raise DegenerateGeometryError(
            f"{num} of {len(points)} matches fit one similarity, need {config.min_inliers} and "
            f"{config.min_inlier_share:.0%}"
        )
    ratios = points.a.misfit(a_from_b.apply(points.b.points))[is_inlier, 2]
    return Measurement(
        a_from_b,
        _covariance(points, a_from_b, noise, a),
        num,
        len(points),
        float(np.median(np.abs(ratios))),
        "matches",
    )


def _refine(points: Correspondences, a_from_b: Sim3, config: ClosuresConfig) -> tuple[Sim3, _Noise]:
    """Minimise what matches and depths leave, again and again with what that says of the noise."""
    noise = _estimate_noise(points, a_from_b, config)
    for _round in range(_ROUNDS):
        jacobian, residual, weight = _linearise(points, a_from_b, noise)
        hessian = np.einsum("p,pij,pik->jk", weight, jacobian, jacobian)
        gradient = np.einsum("p,pij,pi->j", weight, jacobian, residual)
        step = -np.linalg.pinv(hessian, rcond=_RANK, hermitian=True) @ gradient
        a_from_b = _stepped(a_from_b, step, points)
        noise = _estimate_noise(points, a_from_b, config)
        if np.abs(step).max() < _CONVERGED:
            break
    return a_from_b, noise


def _stepped(a_from_b: Sim3, step: Array, points: Correspondences) -> Sim3:
    """Turn, move (in median depths) and grow about the mean of b's cameras."""
    pivot = a_from_b.apply(_pivot(points))
    turn = rotation_exp(step[:3])
    growth = float(np.exp(np.clip(step[6], -0.5, 0.5)))
    move = _unit(points) * step[3:6]
    translation = pivot + move + growth * (turn @ (a_from_b.translation - pivot))
    return Sim3(a_from_b.scale * growth, turn @ a_from_b.rotation, translation)


def _unit(points: Correspondences) -> float:
    """Return the median depth of the matches in window a."""
    return float(np.median(points.a.depth))


def _pivot(points: Correspondences) -> Array:
    """Return the mean centre of the cameras, in window b."""
    return np.asarray(points.b.window_from_cam[:, :, 3].mean(axis=0))


def _linearise(
    points: Correspondences, a_from_b: Sim3, noise: _Noise
) -> tuple[Array, Array, NDArray[np.float64]]:
    """Return (P, 3, 7) slopes and (P, 3) misfits, both in sigmas, and (P,) the matches' say.

    What camera a measures of a point is compared with what window b says of it. Both errors are
    carried to a: b's pixel and depth through the projection.
    """
    view, other = points.a, points.b
    in_a = a_from_b.apply(other.points)
    misfit = view.misfit(in_a)
    is_ahead = np.isfinite(misfit[:, 2])
    by_cam = _projection_slopes(view.in_cam(in_a), view.focal)
    cam_from_a = np.swapaxes(view.window_from_cam[:, :, :3], 1, 2)
    by_point = by_cam @ cam_from_a
    arm = in_a - a_from_b.apply(_pivot(points))
    motion = np.concatenate(
        [-cross_matrix(arm), np.tile(_unit(points) * np.eye(3), (len(arm), 1, 1)), arm[:, :, None]],
        axis=2,
    )
    jacobian = by_point @ motion
    turn = a_from_b.scale * (a_from_b.rotation @ other.window_from_cam[:, :, :3])
    by_seen = by_point @ turn @ _seen_slopes(points)
    variance_b = np.stack([*[np.full(len(in_a), noise.pixel**2)] * 2, noise.ratio**2 / 2], axis=1)
    spread = np.einsum("pij,pj,pkj->pik", by_seen, variance_b, by_seen)
    spread[:, range(3), range(3)] += variance_b
    spread[~is_ahead] = np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(spread))
    residual = np.einsum("pij,pj->pi", root, np.where(is_ahead[:, None], misfit, 0))
    squared = (residual**2).sum(axis=1)
    weight = np.where(is_ahead, np.maximum(1 - squared / _REDESCEND, 0) ** 2, 0)
    return root @ np.where(is_ahead[:, None, None], jacobian, 0), residual, weight


def _projection_slopes(cam: Array, focal: Array) -> Array:
    """Return (P, 3, 3) how pixel x, y and log depth follow a point in camera axes."""
    z = np.maximum(cam[:, 2], 1e-3 * np.linalg.norm(cam, axis=1) + np.finfo(np.float32).tiny)
    out = np.zeros((len(cam), 3, 3))
    for axis in (0, 1):
        out[:, axis, axis] = focal[:, axis] / z
        out[:, axis, 2] = -focal[:, axis] * cam[:, axis] / z**2
    out[:, 2, 2] = 1 / z
    return out


def _seen_slopes(points: Correspondences) -> Array:
    """Return (P, 3, 3) how points in b's camera axes follow b's pixel x, y and log depth."""
    seen = points.b
    out = np.zeros((len(points), 3, 3))
    for axis in (0, 1):
        out[:, axis, axis] = seen.depth / seen.focal[:, axis]
    out[:, :, 2] = seen.points_cam
    return out


def _estimate_noise(points: Correspondences, a_from_b: Sim3, config: ClosuresConfig) -> _Noise:
    """Read the noise off the inliers: pixels across the way that depth errors move them."""
    misfit = points.a.misfit(a_from_b.apply(points.b.points))
    near = np.flatnonzero(agreement(points, a_from_b, config) > 0)
    least = _PIXEL_NOISE * points.width / COMMON_WIDTH, _DEPTH_NOISE * np.sqrt(2)
    if len(near) < _DEPTH_GROUPS:
        return _Noise(least[0], np.full(len(points), least[1]))
    pixel = min(_spread(misfit[near, :2].ravel()), _spread(_across(points, a_from_b, misfit)[near]))
    depth = np.log(points.b.depth)
    groups = np.array_split(near[np.argsort(depth[near])], _DEPTH_GROUPS)
    spreads = [_spread(misfit[group, 2]) for group in groups]
    middles = [float(np.median(depth[group])) for group in groups]
    ratio = np.interp(depth, middles, np.maximum.accumulate(spreads))
    return _Noise(max(pixel / np.sqrt(2), least[0]), np.maximum(ratio, least[1]))


def _across(points: Correspondences, a_from_b: Sim3, misfit: Array) -> Array:
    """Return (P,) pixel misfits across the line along which the other end's depth moves a point."""
    cam_b = points.a.in_cam(a_from_b.apply(points.b.window_from_cam[:, :, 3]))
    cam = points.a.in_cam(a_from_b.apply(points.b.points))
    along = np.einsum("pij,pj->pi", _projection_slopes(cam, points.a.focal)[:, :2], cam - cam_b)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    return np.asarray(
        np.einsum("pi,pi->p", np.nan_to_num(misfit[:, :2], posinf=0), normal) / length
    )


def _spread(errors: Array) -> float:
    return 1.4826 * float(np.median(np.abs(errors)))


def _covariance(points: Correspondences, a_from_b: Sim3, noise: _Noise, a: End) -> Array:
    """Return (7, 7) as in ``Measurement``: matches on one object, or of one pair, err together.

    Reference: Liang and Zeger, Biometrika 1986 (the sandwich with clusters).
    """
    jacobian, residual, weight = _linearise(points, a_from_b, noise)
    hessian = np.einsum("p,pij,pik->jk", weight, jacobian, jacobian)
    pull = np.einsum("p,pij,pi->pj", weight, jacobian, residual)
    meat = hessian.copy()
    for cluster, alike in ((_cells(points, a), 1), (points.pair, _PAIRS_ALIKE)):
        sums = np.zeros((int(cluster.max()) + 1, 7))
        np.add.at(sums, cluster, pull)
        num = int(np.count_nonzero(np.bincount(cluster[weight > 0])))
        meat += min(num, alike) * (sums.T @ sums)
    inverse = np.linalg.pinv(hessian, rcond=_RANK, hermitian=True)
    # In one pair of images a single object may have most of the say on the scale.
    few = np.sqrt(_PAIRS_ALIKE / min(len(np.unique(points.pair)), _PAIRS_ALIKE))
    evenness = np.clip(float(np.median(noise.ratio)) / _NETWORK_NOISE, 0.1, 1)
    whole = np.repeat([_TURN, _MOVE, few * evenness * _GROWTH], [3, 3, 1])
    units = np.repeat([1.0, _unit(points), 1.0], [3, 3, 1])
    at_pivot = units[:, None] * (inverse @ meat @ inverse + np.diag(whole**2)) * units
    carry = moved_by(a_from_b.translation, a_from_b.apply(_pivot(points)))
    return np.asarray(carry @ at_pivot @ carry.T)


def _cells(points: Correspondences, a: End) -> NDArray[np.int64]:
    """Return (P,) which cell of the scene each match lies in."""
    pose = a.prediction.window_from_cam[a.matched]
    cam = (points.a.points - pose[:3, 3]) @ pose[:3, :3]
    distance = np.maximum(np.linalg.norm(cam, axis=1), 1e-12)
    angles = np.stack([np.arctan2(cam[:, 0], cam[:, 2]), np.arcsin(cam[:, 1] / distance)], axis=1)
    place = np.concatenate([angles, np.log(distance)[:, None]], axis=1) / _CELLS
    _, cell = np.unique(np.floor(place).astype(np.int64), axis=0, return_inverse=True)
    return np.asarray(cell.ravel())
