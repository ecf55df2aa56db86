"""Which way is down, for the ground must be found: from how cameras are held and what they see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import unproject

Array = NDArray[np.float64]
Map = NDArray[np.float32]

STRIDE = 8  # of the pixels that are looked at
UPRIGHT_WEIGHT = 0.05  # of the mean upright, against cameras that do not roll
CONES_DEG = (45.0, 35.0, 25.0, 15.0, 10.0, 10.0)  # in which level surfaces are looked for
MIN_NORMALS = 50


def guess_down(world_from_cam: Array) -> Array:
    """Guess which way is down: across the cameras' x axes, for people and cars hardly roll.

    Where they all look the same way, it is the mean of their y axes.

    Args:
        world_from_cam: (N, 4, 4).

    Returns:
        (3,) unit vector in the world.
    """
    across = world_from_cam[:, :3, 0]
    upright = world_from_cam[:, :3, 1].mean(axis=0)
    upright /= max(float(np.linalg.norm(upright)), 1e-9)
    cost = across.T @ across / len(across)
    cost += UPRIGHT_WEIGHT * (np.eye(3) - np.outer(upright, upright))
    down = np.linalg.eigh(cost)[1][:, 0]
    return np.asarray(down if down @ upright >= 0 else -down)


def settle_down(down: Array, depths: list[Map], intrinsics: Array, world_from_cam: Array) -> Array:
    """Turn a guess to where floors, roads and tables say that down is.

    Args:
        down: (3,) guess.
        depths: N maps (H, W), z; NaN: unknown.
        intrinsics: (3, 3) in pixels of the maps.
        world_from_cam: (N, 4, 4).

    Returns:
        (3,) unit vector; the guess where nothing level is seen.
    """
    normals = np.concatenate(
        [
            _normals(coarse_points(depth, intrinsics)) @ pose[:3, :3].T
            for depth, pose in zip(depths, world_from_cam, strict=True)
        ]
    )
    for cone_deg in CONES_DEG:
        level = normals[normals @ down > np.cos(np.radians(cone_deg))]
        if len(level) < MIN_NORMALS:
            break
        mean = level.mean(axis=0)
        down = mean / np.linalg.norm(mean)
    return down


def level_axes(down: Array) -> Array:
    """Return the (3, 3) rotation from the world to axes with y down."""
    side = np.linalg.svd(down[None])[2][1]
    return np.stack([side, down, np.cross(side, down)])


def coarse_points(depth: Map, intrinsics: Array) -> Array:
    """Return (h, w, 3) points in camera axes of every so many-th pixel; NaN where unknown."""
    start = STRIDE // 2
    coarse = intrinsics.copy()
    coarse[:2] /= STRIDE
    coarse[:2, 2] -= start / STRIDE
    return unproject(depth[start::STRIDE, start::STRIDE], coarse)


def _normals(points: Array) -> Array:
    """Return (M, 3) unit normals of (h, w, 3) points that turn away from the camera."""
    right, below = points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]
    normals = np.cross(right, below).reshape(-1, 3)
    length = np.linalg.norm(normals, axis=1)
    is_known = np.isfinite(length) & (length > 0)
    normals = normals[is_known] / length[is_known, None]
    seen_along = points[:-1, :-1].reshape(-1, 3)[is_known]
    away = np.sign((normals * seen_along).sum(axis=1))
    return np.asarray(normals * away[:, None])
