"""Camera paths of the synthetic drive. World axes: x right, y down, z forward, metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

CAMERA_HEIGHT_M = 1.65
REVISIT = 1.2  # metres driven per metre of the loop: the first sixth is driven twice
MIN_LOOP_M = 120.0  # a block with turns of 10 m radius is not smaller
SPACING_M = 0.25


def loop_path(num_frames: int, step_m: float, seed: int) -> Array:
    """Drive around city blocks, back to the start and over the first stretch again.

    Straight streets of different lengths and 90-degree turns of 10-15 m radius; slower in the
    turns; pitch, roll and height tremble as a car's do. A drive of less than 145 m is too short
    for a block and does not come back.

    Args:
        num_frames: poses, >= 2.
        step_m: mean distance between them, in metres.
        seed: of the blocks' shape and of the trembling.

    Returns:
        (num_frames, 4, 4) ``world_from_cam`` in metres; the first camera is at the origin.
    """
    rng = np.random.default_rng((seed, 1))
    driven = (num_frames - 1) * step_m
    curve, yaw = _closed_curve(max(driven / REVISIT, MIN_LOOP_M), rng)
    arc = _arc_positions(yaw, num_frames, driven, rng)
    grid = np.arange(len(curve) + 1) * SPACING_M
    x = np.interp(arc % grid[-1], grid, np.append(curve[:, 0], curve[0, 0]))
    z = np.interp(arc % grid[-1], grid, np.append(curve[:, 1], curve[0, 1]))
    turn = yaw[-1] + _angle_step(yaw)[-1]  # one full turn, so that yaw goes on in the second lap
    heading = np.interp(arc % grid[-1], grid, np.append(yaw, turn))
    return _poses(np.stack([x, z], axis=1), heading, rng)


def path_from_kitti_poses(poses: Array) -> Array:
    """Check a trajectory in KITTI's convention and use it as camera path.

    Args:
        poses: (N, 3, 4) or (N, 4, 4) ``world_from_cam``, metres, N >= 2; the camera is 1.65 m
            above the road, so that the road's height follows from them.

    Returns:
        (N, 4, 4) rigid ``world_from_cam``.

    Raises:
        DatasetError: another shape, not finite, or rotations that are none.
    """
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)) or len(poses) < 2:
        raise DatasetError(f"a camera path needs two or more 3x4 poses, got shape {poses.shape}")
    if not np.isfinite(poses).all():
        bad = int(np.argmin(np.isfinite(poses).all(axis=(1, 2))))
        raise DatasetError(f"pose {bad} of the camera path is not finite; remove or repair it")
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3] = poses[:, :3]
    gram = np.einsum("nij,nkj->nik", out[:, :3, :3], out[:, :3, :3])
    wrong = np.abs(gram - np.eye(3)).max(axis=(1, 2)) > 1e-3
    if wrong.any() or (np.linalg.det(out[:, :3, :3]) < 0).any():
        raise DatasetError(
            f"pose {int(np.argmax(wrong))} of the camera path has no rotation matrix; "
            "lines must hold [R | t] of world_from_cam, row by row"
        )
    return out


def read_kitti_poses(path: Path) -> Array:
    """Read a trajectory file in KITTI's format: 12 numbers a line, the rows of [R | t].

    Returns:
        (N, 4, 4) rigid ``world_from_cam``.

    Raises:
        DatasetError: missing, not numbers, not 12 columns, not finite, or too short.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
        rows = [np.array(line.split(), dtype=np.float64) for line in lines if line.strip()]
    except OSError as error:
        raise DatasetError(f"cannot read poses file {path}: {error.strerror}") from error
    except ValueError as error:
        raise DatasetError(f"{path} is no KITTI poses file: {error}") from error
    for number, row in enumerate(rows, start=1):
        if len(row) != 12:
            raise DatasetError(f"{path}: line {number} has {len(row)} numbers, KITTI poses have 12")
    try:
        return path_from_kitti_poses(np.array(rows).reshape(-1, 3, 4))
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from error


def _closed_curve(length: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (M, 2) plan points, one per SPACING_M, and their unwrapped yaw; yaw 0 is +z."""
    corners = _block_corners(length, rng)
    radii = rng.uniform(10.0, 15.0 if length > 250 else 11.5, len(corners))
    scale = length / np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum()
    for _ in range(6):  # rounding and smoothing shorten the loop by an amount that is not scaled
        points = _resample(_rounded(corners * scale, radii))
        scale *= length / (len(points) * SPACING_M)
    if rng.random() < 0.5:  # the other way round
        points = points * np.array([-1.0, 1.0])
    step = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 0], step[:, 1]))
    return points - points[0], yaw - np.round(yaw[0] / (2 * np.pi)) * 2 * np.pi


def _block_corners(length: float, rng: np.random.Generator) -> Array:
    """Return the corners of a right-angled block (unscaled), the first edge along +z."""
    a, b = 1.0, rng.uniform(0.62, 0.8)
    if length < 320:
        return np.array([[0, 0], [0, a], [b, a], [b, 0]])
    c, d = rng.uniform(0.42, 0.55, 2)
    if length < 700:  # one quarter less: L
        return np.array([[0, 0], [0, a], [b * c, a], [b * c, a * d], [b, a * d], [b, 0]])
    e = rng.uniform(0.3, 0.45)  # two opposite quarters less: Z
    left = [[0, a * e], [0, a], [b * c, a], [b * c, a * 0.72]]
    return np.array([*left, [b, a * 0.72], [b, 0], [b * 0.36, 0], [b * 0.36, a * e]])


def _rounded(corners: Array, radii: Array) -> Array:
    """Replace corners by arcs; the curve starts a few metres behind the first corner."""
    pieces = []
    for i in range(len(corners)):
        corner, before = corners[i], corners[i - 1]
        after = corners[(i + 1) % len(corners)]
        towards = (corner - before) / np.linalg.norm(corner - before)
        away = (after - corner) / np.linalg.norm(after - corner)
        angle = np.linspace(0.0, np.pi / 2, 40)[:, None]
        center = corner + radii[i] * (away - towards)
        pieces.append(center - radii[i] * (away * np.cos(angle) - towards * np.sin(angle)))
    curve = np.concatenate(pieces)
    start = curve[39] + 6.0 * (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    return np.concatenate([[start], curve[40:], curve[:40], [start]])


def _resample(curve: Array) -> Array:
    """Space a closed curve evenly and round its curvature off."""
    for sigma_m in (2.0, 0.0):
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        at = np.linspace(0.0, arc[-1], round(arc[-1] / SPACING_M), endpoint=False)
        points = np.stack([np.interp(at, arc, curve[:, k]) for k in (0, 1)], axis=1)
        if sigma_m:
            points = gaussian_filter1d(points, sigma_m / SPACING_M, axis=0, mode="wrap")
        curve = np.concatenate([points, points[:1]])
    return points


def _angle_step(yaw: Array) -> Array:
    return np.append(np.diff(yaw), yaw[-1] - yaw[-2])


def _arc_positions(yaw: Array, num: int, driven: float, rng: np.random.Generator) -> Array:
    """Place the frames along the curve: slower in turns, never quite even; (num,) metres."""
    curvature = gaussian_filter1d(np.abs(_angle_step(yaw)), 4.0 / SPACING_M, mode="wrap")
    slow = 1.0 - 0.35 * np.clip(curvature / SPACING_M * 11.0, 0.0, 1.0)
    even = np.linspace(0.0, driven, num)
    at = (even / SPACING_M).astype(np.int64) % len(yaw)
    step = slow[at] * (1.0 + _smooth_noise(num, 12.0, 0.08, rng).clip(-0.2, 0.2))
    arc = np.concatenate([[0.0], np.cumsum(step[1:])])
    return np.asarray(arc * (driven / arc[-1]))


def _smooth_noise(num: int, sigma: float, std: float, rng: np.random.Generator) -> Array:
    noise = gaussian_filter1d(rng.standard_normal(num + 64), sigma)[32 : 32 + num]
    return np.asarray(noise * std * np.sqrt(2.0 * np.sqrt(np.pi) * sigma))


def _hill(plan: Array) -> Array:
    """Return the road's height (N,) above the origin's, in metres: gentle, long waves."""
    x, z = plan[:, 0], plan[:, 1]
    waves = 0.7 * np.sin(x / 31.0 + 0.4) + 0.8 * np.sin(z / 37.0 + 1.1)
    return np.asarray(waves + 0.4 * np.sin((x + z) / 19.0))


def _poses(plan: Array, yaw: Array, rng: np.random.Generator) -> Array:
    num = len(plan)
    ahead = np.stack([np.sin(yaw), np.cos(yaw)], axis=1)
    right = np.stack([np.cos(yaw), -np.sin(yaw)], axis=1)
    plan = plan + right * _smooth_noise(num, 14.0, 0.12, rng)[:, None]
    height = _hill(plan)
    slope = np.arctan2(_hill(plan + ahead) - height, 1.0)
    angles = np.stack(
        [
            yaw + np.radians(_smooth_noise(num, 5.0, 0.15, rng)),
            slope + np.radians(_smooth_noise(num, 3.0, 0.2, rng)),
            np.radians(_smooth_noise(num, 5.0, 0.25, rng)),
        ],
        axis=1,
    )
    world_from_cam = np.tile(np.eye(4), (num, 1, 1))
    world_from_cam[:, :3, :3] = Rotation.from_euler("YXZ", angles).as_matrix()
    world_from_cam[:, 0, 3] = plan[:, 0]
    world_from_cam[:, 1, 3] = -height + _smooth_noise(num, 3.0, 0.012, rng)
    world_from_cam[:, 2, 3] = plan[:, 1]
    world_from_cam[:, :3, 3] -= world_from_cam[0, :3, 3]
    return world_from_cam
