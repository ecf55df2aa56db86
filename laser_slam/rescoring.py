"""Score a finished run again, perhaps against a truth that came later."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from laser_slam.errors import DatasetError
from laser_slam.evaluation.trajectory import evaluate_trajectory
from laser_slam.results import (
    CHAINED_FILE,
    describe_paths,
    draw_trajectory,
    read_report,
    rescale_windows,
    write_report,
    write_report_page,
)
from laser_slam.types import Trajectory

Array = NDArray[np.float64]


def rescore(folder: Path, truth_file: Path | None = None) -> dict[str, Any]:
    """Compare a run's trajectory with the truth; write its scores, their pictures and page anew.

    Where there is no truth and the page is missing, only that is written.

    Args:
        folder: of a finished run.
        truth_file: poses in metres, KITTI's format (a line for every frame) or TUM's (by time);
            None: the truth that the run itself had.

    Returns:
        The report, with the new scores in it.

    Raises:
        RunFolderError: no finished run is there, or it cannot be written.
        DatasetError: there is no truth, it cannot be read or does not fit the run.
    """
    report = dict(read_report(folder))
    kept = folder / "truth_tum.txt"
    if truth_file is not None or kept.exists():
        _score(folder, report, truth_file or kept, has_same_truth=truth_file is None)
        write_report(folder / "report.json", report)
    elif (folder / "report.html").exists():
        raise DatasetError(f"the run in {folder} had no truth; pass a file of poses with --truth")
    write_report_page(folder)
    return report


def _score(folder: Path, report: dict[str, Any], file: Path, *, has_same_truth: bool) -> None:
    """Put the scores by a truth into a report."""
    trajectory = read_trajectory(folder / "trajectory_tum.txt", None)
    truth = read_trajectory(file, trajectory.times_s)
    errors = evaluate_trajectory(trajectory, truth)
    if errors.reason is not None:
        raise DatasetError(f"{file} cannot score {folder}: {errors.reason}")
    draw_trajectory(folder / "pictures", trajectory, truth, errors)
    before = _metres_per_unit(report)
    report["trajectory"] = errors.numbers()
    chained, without = None, None
    if report.get("closures") and (folder / CHAINED_FILE).exists():
        chained = read_trajectory(folder / CHAINED_FILE, None)
        without = evaluate_trajectory(chained, truth)
        report["closures"]["trajectory_without"] = without.numbers()
    report["paths"] = describe_paths(trajectory, chained, truth, (errors, without))
    if "records" in report.get("windows", {}):
        now = _metres_per_unit(report | {"windows": {"unit": "m"}})
        metres = (_ratio(now[0], before[0]), _ratio(now[1], before[1]))
        report["windows"] = rescale_windows(
            report["windows"], metres, has_same_truth=has_same_truth
        )


def _metres_per_unit(report: dict[str, Any]) -> tuple[float | None, float | None]:
    """Return the report's unit of windows per world unit, with the loops closed and without."""
    if report.get("windows", {}).get("unit") != "m":
        return 1.0, 1.0
    closures = report.get("closures") or {}
    parts = (report.get("trajectory"), closures.get("trajectory_without"))
    with_loops, without = (part["scale"] if part else None for part in parts)
    return with_loops, without


def _ratio(new: float | None, old: float | None) -> float | None:
    return new / old if new and old else None


def read_trajectory(path: Path, times_s: Array | None) -> Trajectory:
    """Read poses in KITTI's format (12 numbers a line) or TUM's (8).

    Args:
        path: of the file.
        times_s: seconds of the sequence's frames, by which poses find their frame; None: the
            file itself is in TUM's format and has a line for every frame.

    Raises:
        DatasetError: the file is missing, no table of poses, or of another length.
    """
    table = _read_table(path)
    if table.shape[1] == 12:
        if times_s is None or len(table) != len(times_s):
            wanted = "times" if times_s is None else f"{len(times_s)} lines, one for every frame"
            raise DatasetError(f"{path} has {len(table)} poses without time, need {wanted}")
        world_from_cam = np.tile(np.eye(4), (len(table), 1, 1))
        world_from_cam[:, :3] = table.reshape(-1, 3, 4)
        return Trajectory(np.arange(len(table)), times_s, world_from_cam)
    world_from_cam = np.tile(np.eye(4), (len(table), 1, 1))
    world_from_cam[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    world_from_cam[:, :3, 3] = table[:, 1:4]
    if times_s is None:
        return Trajectory(np.arange(len(table)), table[:, 0], world_from_cam)
    return _at_frames(table[:, 0], world_from_cam, times_s)


def _at_frames(pose_times_s: Array, world_from_cam: Array, times_s: Array) -> Trajectory:
    """Give each frame the pose that is nearest in time, within half a frame."""
    order = np.argsort(pose_times_s)
    right = np.clip(np.searchsorted(pose_times_s[order], times_s), 1, len(order) - 1)
    pair = np.stack([right - 1, right]) if len(order) > 1 else np.zeros((2, len(times_s)), int)
    gaps = np.abs(pose_times_s[order][pair] - times_s)
    nearest = order[np.take_along_axis(pair, gaps.argmin(axis=0)[None], axis=0)[0]]
    reach = 0.5 * float(np.median(np.diff(times_s))) if len(times_s) > 1 else np.inf
    frames = np.flatnonzero(gaps.min(axis=0) <= reach)
    return Trajectory(frames, times_s[frames], world_from_cam[nearest[frames]])


def _read_table(path: Path) -> Array:
    try:
        with warnings.catch_warnings(action="ignore"):  # an empty file, said better below
            table = np.loadtxt(path, ndmin=2)
    except OSError as error:
        raise DatasetError(f"cannot read poses {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise DatasetError(f"{path} is no table of poses: {error}") from error
    if table.shape[1] not in (8, 12) or not len(table) or not np.isfinite(table).all():
        raise DatasetError(
            f"{path} has {table.shape[0]} lines of {table.shape[1]} numbers; "
            "poses have 12 finite numbers a line (KITTI) or 8 (TUM)"
        )
    if table.shape[1] == 8 and not np.linalg.norm(table[:, 4:], axis=1).all():
        raise DatasetError(f"{path} has a quaternion of zeros; TUM's lines are t x y z qx qy qz qw")
    return np.asarray(table, np.float64)
