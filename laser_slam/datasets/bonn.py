"""Bonn RGB-D Dynamic: people and boxes move before a hand-held depth camera."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.lens import Lens
from laser_slam.datasets.listed import ListedSequence, Shot
from laser_slam.datasets.timed_lists import AGAIN, read_shots, refuse_name, sequence_folder
from laser_slam.datasets.tum_rgbd import SIZE, UNITS_PER_M
from laser_slam.errors import DatasetError
from laser_slam.sim3 import orthonormal

Array = NDArray[np.float64]

LENS = Lens(
    intrinsics_matrix(542.822841, 542.576870, 315.593520, 237.756098),
    "Bonn RGB-D Dynamic, published",
    SIZE,
    np.array([0.039903, -0.099343, -0.000730, -0.000144, 0.0]),
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
        folder: of one sequence, such as ``rgbd_bonn_balloon2``; or the ``rgb_110`` in it that
            published evaluations copy their images to.
        by_rank: give the n-th image the n-th depth map in order of names, however far apart in
            time, as published evaluations do; of an ``rgb_110``, out of ``depth_110``.
        rectify: take the lens distortion out, of images and depth.

    Raises:
        DatasetError: no such sequence there, one of another data set by its name, a list that is
            broken, or lists without common times.
    """

    again = AGAIN

    def __init__(self, folder: Path, *, by_rank: bool = False, rectify: bool = False) -> None:
        refuse_name(folder, "rgbd_dataset_freiburg", "tum-rgbd")
        shots = [_of_camera(shot) for shot in read_shots(folder)]
        super().__init__(
            f"bonn-{sequence_folder(folder).resolve().name.removeprefix('rgbd_bonn_')}",
            _ranked(folder, shots) if by_rank else shots,
            LENS,
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN),
            rectify=rectify,
        )


def _ranked(folder: Path, shots: list[Shot]) -> list[Shot]:
    """Pair images and depth maps by their places in order of names."""
    home, name = sequence_folder(folder), folder.resolve().name
    depths = home / (name.replace("rgb", "depth") if home != folder else "depth")
    paths = sorted(depths.glob("*.png"))
    if not paths:
        raise DatasetError(f"no depth maps in {depths}; {AGAIN}")
    return [replace(shot, depth=path) for shot, path in zip_longest(shots, paths) if shot]


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
