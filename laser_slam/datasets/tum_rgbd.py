"""TUM RGB-D: a hand-held depth camera, with a trajectory of a motion-capture system."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.listed import Lens, ListedSequence, Shot
from laser_slam.datasets.poses import read_rows, rigid_or_none
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

UNITS_PER_M = 5000.0
MAX_GAP_S = 0.02  # between what is taken as simultaneous, as the benchmark's own tool has it
SIZE = (480, 640)
AGAIN = "unpack the sequence again"
CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
DISTORTED = {"freiburg1", "freiburg2"}  # the images of freiburg3 were rectified before release


class TumRgbd(ListedSequence):
    """One sequence: ``rgb.txt``, and where they are there ``depth.txt`` and ``groundtruth.txt``.

    Depth is registered with the colour camera, 16 bits, 5000 counts a metre, 0: unknown. Depth
    maps and poses belong to the image that is nearest in time, within 20 ms. Intrinsics are those
    that the benchmark published for the camera that the folder's name tells; its lens distortion
    (freiburg1 and 2) stays in the images.

    Args:
        folder: of one sequence, such as ``rgbd_dataset_freiburg1_desk``.
        posed_only: leave out images without a true pose.

    Raises:
        DatasetError: no such sequence there, a list that is broken, or lists without common times.
    """

    again = AGAIN

    def __init__(self, folder: Path, *, posed_only: bool = False) -> None:
        shots = read_shots(folder)
        name = folder.resolve().name
        super().__init__(
            f"tum-{name.removeprefix('rgbd_dataset_')}",
            [shot for shot in shots if not posed_only or shot.world_from_cam is not None],
            _lens(name),
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN),
        )


def _lens(name: str) -> Lens:
    for camera, values in CAMERAS.items():
        if camera in name:
            bent = ", lens distortion left in" if camera in DISTORTED else ", rectified"
            source = f"TUM RGB-D, published for {camera}{bent}"
            return Lens(intrinsics_matrix(*values), source, SIZE)
    return Lens(None, f"unknown: no freiburg1, 2 or 3 in the folder's name '{name}'")


def read_shots(folder: Path) -> list[Shot]:
    """List the frames of a sequence with their depth and poses.

    Args:
        folder: with ``rgb.txt``.

    Returns:
        The frames in order; ``world_from_cam`` as ``groundtruth.txt`` has it.

    Raises:
        DatasetError: a list is missing or broken, or has no time in common with the images.
    """
    if not (folder / "rgb.txt").is_file():
        raise DatasetError(f"no rgb.txt in {folder}; give the folder of one sequence")
    images = _read_images(folder / "rgb.txt")
    times_s = np.array([time for time, _ in images])
    depths = _read_depths(folder / "depth.txt", times_s)
    poses = _read_poses(folder / "groundtruth.txt", times_s)
    return [
        Shot(
            time,
            folder / file,
            None if index not in depths else folder / depths[index],
            poses.get(index),
        )
        for index, (time, file) in enumerate(images)
    ]


def _read_images(path: Path) -> list[tuple[float, str]]:
    """Read lines of a time and a file, whose times must rise."""
    rows = _read_timed(path, 2)
    for (_, before, _), (number, time, _) in pairwise(rows):
        if time <= before:
            raise DatasetError(f"the times in {path} do not rise at line {number}; {AGAIN}")
    return [(time, words[0]) for _, time, words in rows]


def _read_depths(path: Path, times_s: Array) -> dict[int, str]:
    """Read the depth map of each image that has one."""
    partners = _read_partners(path, times_s, 2)
    return {index: words[0] for index, (_, words) in partners.items()}


def _read_poses(path: Path, times_s: Array) -> dict[int, Array]:
    """Read ``time tx ty tz qx qy qz qw``: the camera in the world, metres."""
    partners = _read_partners(path, times_s, 8)
    poses = {index: _pose(path, number, words) for index, (number, words) in partners.items()}
    return {index: pose for index, pose in poses.items() if pose is not None}


def _read_timed(path: Path, columns: int) -> list[tuple[int, float, list[str]]]:
    """Read the line number, the time and the other words of each line."""
    rows = []
    for number, words in read_rows(path, AGAIN):
        try:
            time = float(words[0])
        except ValueError:
            time = np.nan
        if len(words) < columns or not np.isfinite(time):
            raise DatasetError(
                f"line {number} of {path} must hold a time and {columns - 1} "
                f"value{'s' if columns > 2 else ''}; {AGAIN}"
            )
        rows.append((number, time, words[1:]))
    if not rows:
        raise DatasetError(f"{path} is empty; {AGAIN}")
    return rows


def _read_partners(path: Path, times_s: Array, columns: int) -> dict[int, tuple[int, list[str]]]:
    """Find the line that belongs to each image; none where there is no such file.

    Lines may come in any order and twice, as the benchmark's own tool allows.
    """
    if not path.is_file():
        return {}
    rows = _read_timed(path, columns)
    others_s, first = np.unique([time for _, time, _ in rows], return_index=True)
    found = {index: rows[first[i]] for index, i in _partners(times_s, others_s, path).items()}
    return {index: (number, words) for index, (number, _, words) in found.items()}


def _pose(path: Path, number: int, words: list[str]) -> Array | None:
    try:
        values = np.array([float(word) for word in words[:7]])
    except ValueError as error:
        raise DatasetError(f"line {number} of {path} holds no pose; {AGAIN}") from error
    if not (np.isfinite(values).all() and np.linalg.norm(values[3:]) > 0.5):
        return None  # tracking was lost
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    world_from_cam[:3, 3] = values[:3]
    return rigid_or_none(world_from_cam)


def _partners(times_s: Array, others_s: Array, path: Path) -> dict[int, int]:
    """Pair times that are nearest to each other both ways, and near enough.

    Returns:
        Index of a time to index of the other; those without a partner are left out.

    Raises:
        DatasetError: nothing can be paired.
    """
    there, back = _nearest(times_s, others_s), _nearest(others_s, times_s)
    index = np.arange(len(times_s))
    is_pair = (back[there] == index) & (np.abs(others_s[there] - times_s) <= MAX_GAP_S)
    if not is_pair.any():
        raise DatasetError(
            f"no time in {path} is within {1000 * MAX_GAP_S:g} ms of an image "
            f"(images from {times_s[0]:.3f} to {times_s[-1]:.3f} s, there {others_s[0]:.3f} to "
            f"{others_s[-1]:.3f} s); {AGAIN}"
        )
    return {int(i): int(there[i]) for i in index[is_pair]}


def _nearest(times_s: Array, others_s: Array) -> NDArray[np.int64]:
    """Return the index of the nearest of the rising others for each time."""
    right = np.clip(np.searchsorted(others_s, times_s), 1, max(1, len(others_s) - 1))
    if len(others_s) == 1:
        return np.zeros(len(times_s), np.int64)
    is_left = times_s - others_s[right - 1] <= others_s[right] - times_s
    return np.asarray(right - is_left, np.int64)
