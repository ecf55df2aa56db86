"""One sequence of Microsoft's 7-Scenes: a hand-held depth camera in a room, with poses."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix, resize_intrinsics
from laser_slam.datasets.decoding import (
    Stream,
    check_same_kind,
    give_up_if_unreadable,
    read_ahead,
    read_depth,
    read_image,
)
from laser_slam.errors import DatasetError
from laser_slam.sim3 import orthonormal
from laser_slam.types import Frame, SequenceInfo, Trajectory

Array = NDArray[np.float64]

FPS = 30.0
NOMINAL_INTRINSICS = intrinsics_matrix(585.0, 585.0, 320.0, 240.0)  # of the official page
NOMINAL_SIZE = (480, 640)
UNITS_PER_M = 1000.0
INVALID = (0, 65535)
MAX_SKEW = 1e-3  # how far a pose may be from a rotation
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpe?g)", re.IGNORECASE)
AGAIN = "unpack the sequence again"


class SevenScenes:
    """One sequence: ``frame-000000.color.png`` (or .jpg), ``.depth.png`` and ``.pose.txt`` each.

    Depth is that of the depth camera, 16 bits, in millimetres; it is taken as registered with the
    colour camera, which the release does not promise (off by some pixels). A frame whose pose is
    missing, not finite or no rigid motion has no true pose. There are no times: 30 frames a
    second by the number in the name, so frames that were left out leave a gap.

    Args:
        folder: of one sequence, such as ``kitchen/seq-01``.

    Raises:
        DatasetError: no such images there, images of several sizes, or a pose file that does not
            hold 16 numbers.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._paths = _list_frames(folder)
        self._files = list(self._paths.values())
        header = check_same_kind(self._files, AGAIN)
        named = folder.resolve()
        self._info = SequenceInfo(
            f"7scenes-{named.parent.name}-{named.name}",
            header.size,
            len(self._files),
            resize_intrinsics(NOMINAL_INTRINSICS, NOMINAL_SIZE, header.size),
            "7-Scenes, nominal",
            _read_truth(self._paths),
            tuple(self._files),
        )

    @property
    def info(self) -> SequenceInfo:
        """Say what is known before the images are read."""
        return self._info

    def frames(self) -> Stream[Frame]:
        """Read the images in order, a few ahead; an unreadable one comes as None.

        Raises:
            DatasetError: the first image or more than half of all are unreadable.
        """
        jobs = (
            partial(_read, index, number, path)
            for index, (number, path) in enumerate(self._paths.items())
        )
        return give_up_if_unreadable(read_ahead(jobs), self._folder, len(self._paths))

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        """Return the (H, W) true depth z in metres, NaN: unknown; None: this frame has none.

        Raises:
            DatasetError: the depth map is broken, not 16-bit grey, or of another size.
        """
        path = _beside(self._files[frame], "depth.png")
        if not path.is_file():
            return None
        return read_depth(path, self._info.size, UNITS_PER_M, AGAIN, INVALID)


def _read(index: int, number: int, path: Path) -> Frame:
    return Frame(index, number / FPS, read_image(path))


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
        raise DatasetError(
            f"no images such as frame-000000.color.png in {folder}{listed}; "
            "give the folder of one 7-Scenes sequence"
        )
    return {number: found[number] for number in sorted(found)}


def _read_truth(paths: dict[int, Path]) -> Trajectory | None:
    """Read camera-to-world poses, of the frames that have a good one; None: no frame has."""
    numbers = list(paths)
    poses = {i: _read_pose(_beside(path, "pose.txt")) for i, path in enumerate(paths.values())}
    good = {index: pose for index, pose in poses.items() if pose is not None}
    if not good:
        return None
    times_s = np.array([numbers[index] / FPS for index in good])
    return Trajectory(np.array(list(good), np.int64), times_s, np.stack(list(good.values())))


def _read_pose(path: Path) -> Array | None:
    """Read world_from_cam; None: there is none, or tracking was lost."""
    if not path.is_file():
        return None
    try:
        numbers = np.array([float(part) for part in path.read_text(encoding="utf-8").split()])
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read the pose {path} ({error}); {AGAIN}") from error
    if numbers.shape != (16,):
        raise DatasetError(f"{path} must hold 4x4 numbers, got {len(numbers)}; {AGAIN}")
    world_from_cam = numbers.reshape(4, 4)
    rotation = world_from_cam[:3, :3]
    is_rigid = (
        np.isfinite(world_from_cam).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_SKEW)
        and np.linalg.det(rotation) > 0
        and np.allclose(world_from_cam[3], [0, 0, 0, 1])
    )
    if not is_rigid:
        return None
    world_from_cam[:3, :3] = orthonormal(rotation)
    return np.asarray(world_from_cam)
