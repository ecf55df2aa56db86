"""One sequence of Microsoft's 7-Scenes: a hand-held depth camera in a room, with poses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from laser_slam.camera import intrinsics_matrix, resize_intrinsics
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.depth_registration import register_depth
from laser_slam.datasets.lens import Depth, Lens
from laser_slam.datasets.listed import ListedSequence, Shot
from laser_slam.datasets.poses import read_pose
from laser_slam.errors import DatasetError

FPS = 30.0
SIZE = (480, 640)
K = intrinsics_matrix(525.0, 525.0, 320.0, 240.0)
# What SimpleRecon's script has, which published evaluations move depth with: the focal length of
# the official page, and the place of the colour camera in another Kinect, as of most of them.
DEPTH_K = intrinsics_matrix(585.0, 585.0, 319.5, 239.5)
CAM_FROM_DEPTH_CAM = np.array(
    [
        [0.99996518, 0.00267651265, -0.00790410123, -0.0255589432],
        [-0.00274093113, 0.999963028, -0.00815045208, 0.000101096363],
        [0.00788199421, 0.00817183288, 0.999935546, 0.00203183217],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
MOVED = "depth.proj.png"
UNITS_PER_M = 1000.0
INVALID = (0, 65535)
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpe?g)", re.IGNORECASE)
AGAIN = "unpack the sequence again"


class SevenScenes(ListedSequence):
    """One sequence: ``frame-000000.color.png`` (or .jpg), ``.depth.png`` and ``.pose.txt`` each.

    Depth is 16 bits, in millimetres, as the depth camera saw it, which sits beside the colour
    camera and has another focal length. The release has no calibration of the two; published
    evaluations move it to the colour camera by that of another Kinect, and so does this reader.
    Where they have left their ``.depth.proj.png``, that is read as it is, for all frames.

    Intrinsics are the colour camera's, poses the depth camera's, as published evaluations have it.
    A frame whose pose is missing, not finite or no rigid motion has no true pose. There are no
    times: 30 frames a second by the number in the name, so frames that were left out leave a gap.

    Args:
        folder: of one sequence, such as ``redkitchen/seq-03``.

    Raises:
        DatasetError: no such images there, images of several sizes, or a pose file that does not
            hold 16 numbers.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        named = folder.resolve()
        frames = _list_frames(folder)
        is_moved = any(_beside(path, MOVED).is_file() for path in frames.values())
        ending = MOVED if is_moved else "depth.png"
        super().__init__(
            f"7scenes-{named.parent.name}-{named.name}",
            [_shot(number, path, ending) for number, path in frames.items()],
            Lens(K, "7-Scenes, colour camera, nominal", SIZE),
            _read if is_moved else _read_and_move,
        )


def _read(path: Path, size: tuple[int, int]) -> Depth:
    return read_depth(path, size, UNITS_PER_M, AGAIN, INVALID)


def _read_and_move(path: Path, size: tuple[int, int]) -> Depth:
    depth_K, color_K = (resize_intrinsics(matrix, SIZE, size) for matrix in (DEPTH_K, K))
    return register_depth(_read(path, size), depth_K, color_K, CAM_FROM_DEPTH_CAM)


def _shot(number: int, color: Path, ending: str) -> Shot:
    depth = _beside(color, ending)
    pose = read_pose(_beside(color, "pose.txt"), AGAIN)
    return Shot(number / FPS, color, depth if depth.is_file() else None, pose)


def _beside(color: Path, ending: str) -> Path:
    return color.with_name(f"{color.name.split('.')[0]}.{ending}")


def _list_frames(folder: Path) -> dict[int, Path]:
    """List the colour images in order, by the numbers in their names."""
    if not folder.is_dir():
        raise DatasetError(f"no folder {folder}; give the folder of one 7-Scenes sequence")
    matches = ((COLOR_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    found = {int(match[1]): path for match, path in matches if match is not None}
    if not found:
        inside = sorted(path.name for path in folder.iterdir() if path.is_dir())
        listed = f" (folders there: {', '.join(inside[:20])})" if inside else ""
        zipped = sorted(path.name for path in folder.glob("seq-*.zip"))
        if zipped and not inside:
            raise DatasetError(f"{folder} holds {zipped[0]}; unpack it, and give its folder")
        raise DatasetError(
            f"no images such as frame-000000.color.png in {folder}{listed}; "
            "give the folder of one 7-Scenes sequence"
        )
    return {number: found[number] for number in sorted(found)}
