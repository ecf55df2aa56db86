"""Lists of times and files or poses, as TUM RGB-D has them, and what belongs together."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from laser_slam.datasets.listed import Shot
from laser_slam.datasets.poses import read_rows, rigid_or_none
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

MAX_GAP_S = 0.02  # between what is taken as simultaneous, as the benchmark's own tool has it
AGAIN = "unpack the sequence again"
IMAGES = "rgb"
PREPARED = f"{IMAGES}_"  # begins the folder of chosen images that published evaluations copy


@dataclass(frozen=True)
class _Row:
    """One line of a list, without its time."""

    number: int
    words: list[str]


def read_shots(folder: Path) -> list[Shot]:
    """List the frames of a sequence with their depth and poses.

    Args:
        folder: with ``rgb.txt``; or its ``rgb_90`` or ``rgb_110`` of images called by their times,
            with ``depth.txt``, ``groundtruth.txt`` or else ``groundtruth_90.txt`` beside it.

    Returns:
        The frames in order; ``world_from_cam`` as ``groundtruth.txt`` has it.

    Raises:
        DatasetError: a list is missing or broken, or has no time in common with the images.
    """
    home = sequence_folder(folder)
    images = _list_prepared(folder) if home != folder else _read_images(folder)
    times_s = np.array([time for time, _ in images])
    truth = home / "groundtruth.txt"
    if home != folder and not truth.is_file():
        truth = home / f"groundtruth_{folder.resolve().name.removeprefix(PREPARED)}.txt"
    depths, poses = _read_depths(home / "depth.txt", times_s), _read_poses(truth, times_s)
    return [
        Shot(time, path, depths.get(index), poses.get(index))
        for index, (time, path) in enumerate(images)
    ]


def refuse_name(folder: Path, beginning: str, command: str) -> None:
    """Refuse what is called as sequences of the same layout with another camera are.

    Raises:
        DatasetError: its name has this beginning.
    """
    name = sequence_folder(folder).resolve().name
    if name.startswith(beginning):
        raise DatasetError(
            f"{name} has the camera and the poses of another data set by its name; "
            f"read it with 'laser-slam {command}'"
        )


def sequence_folder(folder: Path) -> Path:
    """Return the folder of the whole sequence that a folder of chosen images lies in."""
    named = folder.resolve()
    is_prepared = named.name.startswith(PREPARED) and not (named / "rgb.txt").is_file()
    return named.parent if is_prepared else folder


def _list_prepared(folder: Path) -> list[tuple[float, Path]]:
    """List images that are called by their times, in order."""
    timed = [(_number(path.stem), path) for path in folder.glob("*.png")]
    images = sorted((time, path) for time, path in timed if np.isfinite(time))
    if not images:
        raise DatasetError(f"no images called by their times in {folder}; give another folder")
    return images


def _read_images(folder: Path) -> list[tuple[float, Path]]:
    """Read lines of a time and a file, whose times must rise."""
    path = folder / "rgb.txt"
    if not path.is_file():
        prepared = sorted(found.name for found in folder.glob(f"{PREPARED}*") if found.is_dir())
        which = f"{folder / prepared[0]}" if prepared else "the folder of one sequence"
        raise DatasetError(f"no rgb.txt in {folder}; give {which}")
    rows = _read_timed(path, 2)
    for (before, _), (time, row) in pairwise(rows):
        if time <= before:
            raise DatasetError(f"the times in {path} do not rise at line {row.number}; {AGAIN}")
    return [(time, folder / row.words[0]) for time, row in rows]


def _read_depths(path: Path, times_s: Array) -> dict[int, Path]:
    """Read the depth map of each image that has one."""
    partners = _read_partners(path, times_s, 2)
    return {index: path.parent / row.words[0] for index, row in partners.items()}


def _read_poses(path: Path, times_s: Array) -> dict[int, Array]:
    """Read ``time tx ty tz qx qy qz qw``: the camera in the world, metres."""
    partners = _read_partners(path, times_s, 8)
    poses = {index: _pose(path, row) for index, row in partners.items()}
    return {index: pose for index, pose in poses.items() if pose is not None}


def _read_timed(path: Path, columns: int) -> list[tuple[float, _Row]]:
    """Read the time and the other words of each line."""
    rows = []
    for number, words in read_rows(path, AGAIN):
        time = _number(words[0])
        if len(words) < columns or not np.isfinite(time):
            raise DatasetError(
                f"line {number} of {path} must hold a time and {columns - 1} "
                f"value{'s' if columns > 2 else ''}; {AGAIN}"
            )
        rows.append((time, _Row(number, words[1:])))
    if not rows:
        raise DatasetError(f"{path} is empty; {AGAIN}")
    return rows


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan


def _read_partners(path: Path, times_s: Array, columns: int) -> dict[int, _Row]:
    """Find the line that belongs to each image; none where there is no such file.

    Lines may come in any order; of two with one time the second holds, as in the benchmark's tool.
    """
    if not path.is_file():
        return {}
    rows = dict(_read_timed(path, columns))
    others_s = np.array(sorted(rows))
    pairs = associate(times_s, others_s)
    if not pairs:
        raise DatasetError(
            f"no time in {path} is within {1000 * MAX_GAP_S:g} ms of an image "
            f"(images from {times_s[0]:.3f} to {times_s[-1]:.3f} s, there {others_s[0]:.3f} to "
            f"{others_s[-1]:.3f} s); {AGAIN}"
        )
    return {index: rows[float(others_s[other])] for index, other in pairs.items()}


def _pose(path: Path, row: _Row) -> Array | None:
    try:
        values = np.array([float(word) for word in row.words[:7]])
    except ValueError as error:
        raise DatasetError(f"line {row.number} of {path} holds no pose; {AGAIN}") from error
    if not (np.isfinite(values).all() and np.linalg.norm(values[3:]) > 0.5):
        return None  # tracking was lost
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    world_from_cam[:3, 3] = values[:3]
    return rigid_or_none(world_from_cam)


def associate(times_s: Array, others_s: Array) -> dict[int, int]:
    """Pair times as the benchmark's ``associate.py`` does: the closest pair first, each once.

    Args:
        times_s: (N,) rising.
        others_s: (M,) rising.

    Returns:
        Index of a time to index of the other, rising; those without a partner are left out.
    """
    first = np.searchsorted(others_s, times_s - MAX_GAP_S, "left")
    end = np.searchsorted(others_s, times_s + MAX_GAP_S, "right")
    candidates = sorted(
        (gap, i, j)
        for i, time in enumerate(times_s)
        for j in range(int(first[i]), int(end[i]))
        if (gap := abs(float(time - others_s[j]))) < MAX_GAP_S
    )
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in candidates:
        if i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return dict(sorted(pairs.items()))
