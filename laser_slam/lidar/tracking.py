"""The path of a camera by the laser scans beside it."""

from __future__ import annotations

from contextlib import closing
from functools import partial

import numpy as np

from laser_slam.bookkeeping import Progress, no_progress
from laser_slam.datasets.decoding import read_ahead
from laser_slam.datasets.velodyne import Velodyne, raise_beams, turn_shares
from laser_slam.lidar_odometry import Turn, track_scans
from laser_slam.types import Trajectory


def track_camera(velodyne: Velodyne, on_progress: Progress = no_progress) -> Trajectory:
    """Find the camera's path by the scans; those that turned while the car moved are straightened.

    Returns:
        ``world_from_cam`` of the frames that have scans, metres; the first is the identity.

    Raises:
        DatasetError: a scan is broken.
        DependencyError: KISS-ICP is not installed.
    """
    frames = np.array(list(velodyne.paths), np.int64)
    poses = []
    with closing(read_ahead(partial(_read, velodyne, int(f)) for f in frames)) as turns:
        for pose in track_scans(turns):
            poses.append(pose)
            on_progress("tracking scans", len(poses), len(frames))
    any_from_cam = np.stack(poses) @ np.linalg.inv(velodyne.rig.cam_from_velo)
    world_from_cam = np.linalg.inv(any_from_cam[0]) @ any_from_cam
    return Trajectory(frames, velodyne.times_s[frames], world_from_cam)


def _read(velodyne: Velodyne, frame: int) -> Turn:
    points = raise_beams(velodyne.points(frame))
    return Turn(frame, points, None if velodyne.is_compensated else turn_shares(points))
