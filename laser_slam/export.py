"""Results in the formats that other programs read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from laser_slam.dependencies import import_open3d
from laser_slam.errors import RunFolderError
from laser_slam.store import atomic_write
from laser_slam.types import Cloud, Trajectory

_LOSSLESS = 0.01  # of a voxel: rounding below this is not seen


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a cloud as binary PLY: positions in world units, colours as bytes, weights.

    Positions are float32 where rounding moves no point by more than a hundredth of a voxel, else
    float64: no offset is taken off, so that every reader sees world coordinates. The weight of a
    point is its property ``weight`` (float32).

    Raises:
        RunFolderError: the folder is missing, cannot be written or is full.
    """
    open3d = import_open3d()
    positions = cloud.points.astype(_position_type(cloud))
    attributes = {
        "positions": positions,
        "colors": cloud.colors,
        "weight": cloud.weights.reshape(-1, 1),
    }
    tensors = open3d.t.geometry.PointCloud()
    for name, values in attributes.items():
        tensors.point[name] = open3d.core.Tensor(np.ascontiguousarray(values))
    needed = sum(values.nbytes for values in attributes.values())
    with atomic_write(path) as partial:
        partial.touch()  # says why a folder cannot be written; Open3D does not
        if len(cloud.points) == 0:
            partial.write_text(_EMPTY_PLY, encoding="ascii")  # Open3D refuses empty clouds
            return
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            written = open3d.t.io.write_point_cloud(str(partial), tensors)
        size = partial.stat().st_size
        if not written or size < needed:
            raise RunFolderError(
                f"cannot write {path}: Open3D wrote {size:,} of {needed:,} bytes; "
                "free some space, or choose another folder"
            )


_EMPTY_PLY = """ply
format binary_little_endian 1.0
element vertex 0
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property float weight
end_header
"""


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
        quat_xyzw = Rotation.from_matrix(trajectory.world_from_cam[:, :3, :3]).as_quat()
        numbers = np.hstack([trajectory.world_from_cam[:, :3, 3], quat_xyzw])
        for time_s, row in zip(trajectory.times_s, numbers, strict=True):
            lines.append(f"{time_s:.9f} " + " ".join(f"{value:.9e}" for value in row))
    _write_lines(path, lines)


def _position_type(cloud: Cloud) -> type[np.float32] | type[np.float64]:
    if not len(cloud.points):
        return np.float32
    rounding = float(np.spacing(np.float32(np.abs(cloud.points).max()))) / 2
    return np.float32 if rounding <= _LOSSLESS * cloud.voxel_size else np.float64


def _write_lines(path: Path, lines: list[str]) -> None:
    with atomic_write(path) as partial:
        partial.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
