"""Trajectories in KITTI's, TUM's and EuRoC's formats, and the pose graph."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from laser_slam.export.base import Source
from laser_slam.export.checks import has_graph
from laser_slam.store import atomic_write
from laser_slam.types import Trajectory

_EUROC_HEADER = (
    "#timestamp [ns], p_x [world units], p_y [world units], p_z [world units], "
    "q_w [], q_x [], q_y [], q_z []"
)


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in KITTI's format: one line a frame, the 12 numbers of a 3x4 pose.

    The pose is ``world_from_cam`` in world units, row by row.

    Raises:
        RunFolderError: the folder is missing, cannot be written or is full.
    """
    rows = trajectory.world_from_cam[:, :3, :].reshape(-1, 12)
    _write_lines(path, [" ".join(f"{value:.9e}" for value in row) for row in rows])


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in TUM's format: ``time tx ty tz qx qy qz qw`` a frame.

    Time in seconds, the camera's position in world units, the rotation camera to world.

    Raises:
        RunFolderError: the folder is missing, cannot be written or is full.
    """
    lines = []
    if len(trajectory.frames):
        numbers = np.hstack([trajectory.world_from_cam[:, :3, 3], _quat_xyzw(trajectory)])
        for time_s, row in zip(trajectory.times_s, numbers, strict=True):
            lines.append(f"{time_s:.9f} " + " ".join(f"{value:.9e}" for value in row))
    _write_lines(path, lines)


def export_kitti(path: Path, source: Source) -> None:
    """Write the pose of every frame; see ``write_kitti``."""
    write_kitti(path, source.trajectory)


def export_tum(path: Path, source: Source) -> None:
    """Write the pose of every frame; see ``write_tum``."""
    write_tum(path, source.trajectory)


def export_euroc(path: Path, source: Source) -> None:
    """Write the pose of every frame in EuRoC's format: ``ns,x,y,z,qw,qx,qy,qz``, camera to world.

    The columns of EuRoC's ground truth that follow, velocities and biases, are not known.

    Raises:
        RunFolderError: the file cannot be written.
    """
    trajectory = source.trajectory
    lines = [_EUROC_HEADER]
    if len(trajectory.frames):
        numbers = np.hstack(
            [trajectory.world_from_cam[:, :3, 3], np.roll(_quat_xyzw(trajectory), 1, axis=1)]
        )
        for time_s, row in zip(trajectory.times_s, numbers, strict=True):
            lines.append(f"{round(time_s * 1e9)}," + ",".join(f"{value:.9e}" for value in row))
    _write_lines(path, lines)


def export_g2o(path: Path, source: Source) -> None:
    """Copy the pose graph of the windows, closures included.

    Raises:
        RunFolderError: the run has none, or the file cannot be written.
    """
    has_graph(source)
    with atomic_write(path) as partial:
        shutil.copyfile(str(source.graph), partial)


def _quat_xyzw(trajectory: Trajectory) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(trajectory.world_from_cam[:, :3, :3]).as_quat())


def _write_lines(path: Path, lines: list[str]) -> None:
    with atomic_write(path) as partial:
        partial.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
