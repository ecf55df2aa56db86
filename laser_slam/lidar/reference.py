"""The metric path of a sequence by its laser scans, for runs to be compared with."""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from laser_slam.bookkeeping import Progress, no_progress
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.velodyne import Velodyne
from laser_slam.dependencies import import_kiss_icp
from laser_slam.errors import DatasetError, RunFolderError
from laser_slam.evaluation import evaluate_trajectory
from laser_slam.evaluation.trajectory import path_distances
from laser_slam.export import write_kitti, write_tum
from laser_slam.lidar.comparison import compare_with_run, refuse_other_input
from laser_slam.lidar.tracking import track_camera
from laser_slam.results import write_report
from laser_slam.store import new_run_folder
from laser_slam.store.files import make_folder
from laser_slam.types import Trajectory

REPORT_FILE = "lidar.json"


class LidarDataset(Dataset, Protocol):
    """A data set with a laser scanner beside the camera."""

    def velodyne(self) -> Velodyne:
        """Return the scans.

        Raises:
            DatasetError: there are none, or nothing says how scanner and camera sit.
        """
        ...


@dataclass(frozen=True)
class LidarReference:
    """What the scans of a sequence give.

    Attributes:
        folder: with ``trajectory_kitti.txt``, ``trajectory_tum.txt`` and ``lidar.json``; where a
            run was compared, with what ``compare_with_run`` writes.
        trajectory: of the camera at the frames that have scans, metres; its first is the world.
        report: all numbers, as in ``lidar.json``.
    """

    folder: Path
    trajectory: Trajectory
    report: dict[str, Any]


def make_reference(
    dataset: LidarDataset,
    out: Path | None = None,
    run: Path | None = None,
    on_progress: Progress = no_progress,
) -> LidarReference:
    """Track the scans, write the camera's path, and compare a run with it.

    Args:
        dataset: a sequence with scans.
        out: new folder; None: ``runs/<sequence>-lidar-<time>``.
        run: a finished run over the same sequence; None: nothing is compared.
        on_progress: called with a stage's name, how much is done and of how much.

    Raises:
        DatasetError: there are fewer than 2 scans, no calibration, or a broken scan.
        RunFolderError: a folder cannot be used, or the run is over other images.
        DegenerateGeometryError: run and scans have no motion in common.
        DependencyError: KISS-ICP is not installed.
    """
    import_kiss_icp()  # what is missing is said before a folder is made
    velodyne = dataset.velodyne()
    if len(velodyne.paths) < 2:
        raise DatasetError(
            f"{next(iter(velodyne.paths.values()))} is the only scan, need 2 to find a motion"
        )
    velodyne.check_files()
    if run is not None:
        refuse_other_input(run, dataset)  # before minutes of tracking
    folder = _new_folder(out, dataset.info.name)
    start_s = time.perf_counter()
    trajectory = track_camera(velodyne, on_progress)
    report = _describe(dataset, velodyne, trajectory)
    report["seconds_per_scan"] = (time.perf_counter() - start_s) / len(velodyne.paths)
    write_kitti(folder / "trajectory_kitti.txt", trajectory)
    write_tum(folder / "trajectory_tum.txt", trajectory)
    write_report(folder / REPORT_FILE, report)
    if run is not None:
        report["comparison"] = compare_with_run(run, trajectory, velodyne, folder, on_progress)
        write_report(folder / REPORT_FILE, report)
    return LidarReference(folder, trajectory, report)


def _describe(dataset: LidarDataset, velodyne: Velodyne, path: Trajectory) -> dict[str, Any]:
    truth = dataset.info.truth
    return {
        "sequence": dataset.info.name,
        "num_scans": len(velodyne.paths),
        "num_frames": len(velodyne.times_s),
        "first_frame": int(path.frames[0]),
        "last_frame": int(path.frames[-1]),
        "path_length_m": float(path_distances(path)[-1]),
        "straightened": not velodyne.is_compensated,
        "kiss_icp": version("kiss-icp"),
        "errors": None if truth is None else evaluate_trajectory(path, truth).numbers(),
    }


def _new_folder(out: Path | None, name: str) -> Path:
    folder = out or new_run_folder(f"{name}-lidar")
    make_folder(folder)
    if any(folder.iterdir()):
        raise RunFolderError(f"{folder} is not empty; choose another with --out")
    return folder
