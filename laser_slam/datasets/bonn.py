"""Bonn RGB-D Dynamic: people and boxes move before a hand-held depth camera."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.listed import Lens, ListedSequence, Shot
from laser_slam.datasets.tum_rgbd import AGAIN, SIZE, UNITS_PER_M, read_shots
from laser_slam.sim3 import orthonormal

Array = NDArray[np.float64]

LENS = Lens(
    intrinsics_matrix(542.822841, 542.576870, 315.593520, 237.756098),
    "Bonn RGB-D Dynamic, published, lens distortion left in",
    SIZE,
)
# The published calibration of the poses. The second one holds a scale of 1.059, which poses in
# metres do not take: it belongs to the depth of the sensor.
TURNED = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
MARKERS_FROM_CAM = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


class Bonn(ListedSequence):
    """One sequence in the layout of TUM RGB-D, with a camera of its own.

    ``groundtruth.txt`` holds the poses of the markers on the sensor, in axes of the
    motion-capture system. They are brought to the colour camera as the data set's page says, by
    ``TURNED @ pose @ TURNED @ MARKERS_FROM_CAM``, of which only the rigid part is taken.

    Args:
        folder: of one sequence, such as ``rgbd_bonn_balloon2``.

    Raises:
        DatasetError: no such sequence there, a list that is broken, or lists without common times.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        name = folder.resolve().name
        super().__init__(
            f"bonn-{name.removeprefix('rgbd_bonn_')}",
            [_of_camera(shot) for shot in read_shots(folder)],
            LENS,
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN),
        )


def _of_camera(shot: Shot) -> Shot:
    """Turn the pose of the markers into that of the camera."""
    if shot.world_from_cam is None:
        return shot
    markers_from_cam = _rigid(MARKERS_FROM_CAM)
    return replace(shot, world_from_cam=TURNED @ shot.world_from_cam @ TURNED @ markers_from_cam)


def _rigid(matrix: Array) -> Array:
    """Return the (4, 4) matrix without its scale, its rotation made exact (it has 4 digits)."""
    out = np.array(matrix)
    out[:3, :3] = orthonormal(matrix[:3, :3])
    return out
