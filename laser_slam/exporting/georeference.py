"""From the run's world to a projected coordinate system."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DatasetError, DegenerateGeometryError
from laser_slam.sim3 import Sim3, umeyama
from laser_slam.types import Cloud, Trajectory

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


def read_georeference(path: Path, trajectory: Trajectory) -> Sim3:
    """Read what places the world in a projected coordinate system.

    Args:
        path: a text file with either the 4x4 matrix ``[s R, t; 0, 1]`` that maps world points
            (x right, y down, z forward of the first camera) to projected ones (such as easting,
            northing, height), or lines ``time x y z``: where the camera was, by the times of the
            sequence in seconds. To these the trajectory is fitted.
        trajectory: a pose for every frame.

    Returns:
        ``projected_from_world``.

    Raises:
        DatasetError: the file is missing, holds neither, or its positions do not determine it.
    """
    table = _read_table(path)
    try:
        if table.shape == (4, 4) and np.array_equal(table[3], [0, 0, 0, 1]):
            return Sim3.from_matrix(table)
        return _fit(path, table, trajectory)
    except DegenerateGeometryError as error:
        raise DatasetError(f"{path} places no map: {error}") from error


def place(cloud: Cloud, projected_from_world: Sim3) -> Cloud:
    """Map a cloud to projected coordinates."""
    normals = cloud.normals
    if normals is not None:
        normals = (normals @ projected_from_world.rotation.T).astype(np.float32)
    return Cloud(
        projected_from_world.apply(cloud.points),
        cloud.colors,
        cloud.weights,
        cloud.voxel_size * projected_from_world.scale,
        normals,
    )


def _fit(path: Path, table: Array, trajectory: Trajectory) -> Sim3:
    times_s, positions = table[:, 0], table[:, 1:]
    known = (times_s >= trajectory.times_s[0]) & (times_s <= trajectory.times_s[-1])
    if known.sum() < 3:
        raise DatasetError(
            f"{path} has {known.sum()} positions in the time of the run "
            f"({trajectory.times_s[0]:g} s to {trajectory.times_s[-1]:g} s), need 3"
        )
    centers = np.stack(
        [
            np.interp(times_s[known], trajectory.times_s, trajectory.world_from_cam[:, axis, 3])
            for axis in range(3)
        ],
        axis=1,
    )
    # Around their means: coordinates of a projection are large, their differences are small.
    middle = positions[known].mean(axis=0)
    fit = umeyama(centers, positions[known] - middle)
    _refuse_a_line(path, centers)
    off = np.linalg.norm(fit.apply(centers) - (positions[known] - middle), axis=1)
    logger.info(
        "geo-referenced by %d positions, which the path passes at %.3g (rms)",
        known.sum(),
        float(np.sqrt((off**2).mean())),
    )
    return Sim3(fit.scale, fit.rotation, fit.translation + middle)


def _refuse_a_line(path: Path, centers: Array) -> None:
    """Refuse positions that leave the roll about their line open."""
    spread = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        raise DatasetError(
            f"the positions of {path} lie on a line, which leaves the map free to roll about it; "
            "give a 4x4 matrix instead"
        )


def _read_table(path: Path) -> Array:
    try:
        with warnings.catch_warnings(action="ignore"):  # an empty file, said better below
            table = np.loadtxt(path, ndmin=2)
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise DatasetError(f"{path} is no table of numbers: {error}") from error
    if table.shape[1:] != (4,) or not np.isfinite(table).all():
        raise DatasetError(
            f"{path} must hold a 4x4 matrix that maps the world to projected coordinates, or "
            "lines of time x y z"
        )
    return np.asarray(table, np.float64)
