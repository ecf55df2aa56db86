"""NRGBD: rendered rooms of 'Neural RGB-D Surface Reconstruction', with exact depth and poses."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth, read_header
from laser_slam.datasets.lens import Lens
from laser_slam.datasets.listed import ListedSequence, Shot, numbered_files, require
from laser_slam.datasets.poses import read_rows, rigid_or_none
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

FPS = 30.0
UNITS_PER_M = 1000.0
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
AGAIN = "unpack the scene again"


class Nrgbd(ListedSequence):
    """One scene: ``images/img0.png``, ``depth/depth0.png``, ``poses.txt`` and ``focal.txt``.

    Depth is the exact one (not ``depth_filtered``), 16 bits, in millimetres, 0: unknown.
    ``poses.txt`` has four lines for each image, camera to world, in OpenGL's axes (x right, y up,
    z backward), which are turned to ours; rows of ``nan``: no true pose. The principal point is
    half the width and height, as the authors' code has it. There are no times: 30 frames a second.

    Args:
        folder: of one scene, such as ``neural_rgbd_data/breakfast_room``.

    Raises:
        DatasetError: no such scene there, images of several sizes, poses or a focal length that
            are broken, or fewer poses than images.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        images = numbered_files(folder / "images", "img", (".png",))
        require(images, "img0.png", folder / "images", "give the folder of one scene")
        depth = numbered_files(folder / "depth", "depth", (".png",))
        poses = _read_poses(folder / "poses.txt", max(images) + 1)
        shots = [
            Shot(number / FPS, path, depth.get(number), poses.get(number))
            for number, path in images.items()
        ]
        super().__init__(
            f"nrgbd-{folder.resolve().name}",
            shots,
            _lens(folder / "focal.txt", shots[0].image),
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN),
        )


def _lens(path: Path, image: Path) -> Lens:
    header = read_header(image)
    if header is None or not path.is_file():
        return Lens(None, "unknown: no focal.txt")
    words = [word for _, row in read_rows(path, AGAIN) for word in row]
    try:
        (focal,) = (float(word) for word in words)
    except ValueError as error:
        raise DatasetError(f"{path} must hold one number, the focal length; {AGAIN}") from error
    height, width = header.size
    return Lens(intrinsics_matrix(focal, focal, width / 2, height / 2), path.name)


def _read_poses(path: Path, num: int) -> dict[int, Array]:
    """Read the poses of the images that have one, turned to OpenCV's axes."""
    if not path.is_file():
        return {}
    rows = read_rows(path, AGAIN)
    if len(rows) < 4 * num:
        raise DatasetError(f"{path} has {len(rows)} lines for {num} images, 4 each; {AGAIN}")
    matrices = np.array([_numbers(path, *row) for row in rows[: 4 * num]]).reshape(num, 4, 4)
    good = {index: rigid_or_none(matrix) for index, matrix in enumerate(matrices)}
    return {i: pose @ OPENGL_FROM_OPENCV for i, pose in good.items() if pose is not None}


def _numbers(path: Path, number: int, words: list[str]) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 4:
        raise DatasetError(f"line {number} of {path} must hold 4 numbers; {AGAIN}")
    return numbers
