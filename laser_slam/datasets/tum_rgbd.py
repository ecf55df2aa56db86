"""TUM RGB-D: a hand-held depth camera, with a trajectory of a motion-capture system."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.lens import Lens
from laser_slam.datasets.listed import ListedSequence
from laser_slam.datasets.timed_lists import AGAIN, read_shots, refuse_name, sequence_folder

UNITS_PER_M = 5000.0
SIZE = (480, 640)
CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
DISTORTIONS = {  # the images of freiburg3 were rectified before release
    "freiburg1": (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
}


class TumRgbd(ListedSequence):
    """One sequence: ``rgb.txt``, and where they are there ``depth.txt`` and ``groundtruth.txt``.

    Depth is registered with the colour camera, 16 bits, 5000 counts a metre, 0: unknown. Depth
    maps and poses belong to the image that the benchmark's ``associate.py`` gives them to, within
    20 ms. Intrinsics and lens distortion are those that the benchmark published for the camera
    that the folder's name tells.

    Args:
        folder: of one sequence, such as ``rgbd_dataset_freiburg1_desk``; or the ``rgb_90`` in it
            that published evaluations copy their images to.
        posed_only: leave out images without a true pose.
        rectify: take the lens distortion out, of images and depth.

    Raises:
        DatasetError: no such sequence there, one of another data set by its name, a list that is
            broken, or lists without common times.
    """

    again = AGAIN

    def __init__(self, folder: Path, *, posed_only: bool = False, rectify: bool = False) -> None:
        refuse_name(folder, "rgbd_bonn_", "bonn")
        shots = read_shots(folder)
        name = sequence_folder(folder).resolve().name
        super().__init__(
            f"tum-{name.removeprefix('rgbd_dataset_')}",
            [shot for shot in shots if not posed_only or shot.world_from_cam is not None],
            _lens(name),
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN),
            rectify=rectify,
        )


def _lens(name: str) -> Lens:
    for camera, values in CAMERAS.items():
        if camera in name:
            bent = DISTORTIONS.get(camera)
            source = f"TUM RGB-D, published for {camera}"
            return Lens(
                intrinsics_matrix(*values),
                source if bent else f"{source}, rectified before release",
                SIZE,
                None if bent is None else np.array(bent),
            )
    return Lens(None, f"unknown: no freiburg1, 2 or 3 in the folder's name '{name}'")
