"""ScanNet: rooms scanned with a depth camera, as the official reader exports its ``.sens``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from laser_slam.datasets.decoding import read_depth, read_header
from laser_slam.datasets.listed import (
    Depth,
    Lens,
    ListedSequence,
    Shot,
    numbered_files,
    require,
)
from laser_slam.datasets.poses import read_matrix, read_pose
from laser_slam.errors import DatasetError

FPS = 30.0
UNITS_PER_M = 1000.0
AGAIN = "export the scene's .sens file again"


class ScanNet(ListedSequence):
    """One scene: ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt``, ``intrinsic/*.txt``.

    Depth is 16 bits, in millimetres, 0: unknown, and smaller than the colour images (640x480 for
    1296x968): it is brought to their size by its nearest pixels, and taken as registered with
    them. A frame whose pose is missing or not finite has no true pose. There are no times: 30
    frames a second by the number in the name.

    Args:
        folder: of one scene, such as ``scene0707_00``.

    Raises:
        DatasetError: no such scene there, images of several sizes, or a broken pose file.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        color = numbered_files(folder / "color", "", (".jpg", ".jpeg", ".png"))
        require(color, "0.jpg", folder / "color", "give the folder of one exported scene")
        depth = numbered_files(folder / "depth", "", (".png",))
        shots = [
            Shot(
                number / FPS,
                path,
                depth.get(number),
                read_pose(folder / "pose" / f"{path.stem}.txt", AGAIN),
            )
            for number, path in color.items()
        ]
        name = f"scannet-{folder.resolve().name}"
        super().__init__(name, shots, _lens(folder), _read_scaled_depth)


def _lens(folder: Path) -> Lens:
    path = folder / "intrinsic" / "intrinsic_color.txt"
    if not path.is_file():
        return Lens(None, "unknown: no intrinsic/intrinsic_color.txt")
    return Lens(read_matrix(path, 4, AGAIN)[:3, :3], f"{path.parent.name}/{path.name}")


def _read_scaled_depth(path: Path, size: tuple[int, int]) -> Depth:
    header = read_header(path)
    if header is None:
        raise DatasetError(f"{path} is no image; {AGAIN}")
    depth = read_depth(path, header.size, UNITS_PER_M, AGAIN)
    if header.size == size:
        return depth
    # INTER_NEAREST would take each block's corner, half a block off
    return np.asarray(cv2.resize(depth, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT))
