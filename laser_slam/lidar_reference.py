"""The metric path of a sequence by its laser scans, for runs to be compared with."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from laser_slam.bookkeeping import Progress, no_progress
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.decoding import read_ahead
from laser_slam.datasets.velodyne import Velodyne, raise_beams, turn_shares
from laser_slam.errors import DatasetError, RunFolderError
from laser_slam.evaluation import evaluate_trajectory
from laser_slam.evaluation.trajectory import path_distances
from laser_slam.export import write_kitti, write_tum
from laser_slam.exporting import ExportOptions
from laser_slam.exporting.run import open_run
from laser_slam.lidar_comparison import compare_with_run
from laser_slam.lidar_odometry import track_scans
from laser_slam.results import write_report
from laser_slam.sim3 import Sim3, interpolate_sim3
from laser_slam.store import new_run_folder
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

REPORT_FILE = "lidar.json"
logger = logging.getLogger(__name__)


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
        folder: with ``trajectory_kitti.txt``, ``trajectory_tum.txt`` and ``lidar.json``.
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
        RunFolderError: a folder cannot be used.
        DegenerateGeometryError: run and scans have no motion in common.
        DependencyError: KISS-ICP is not installed.
    """
    if run is not None:
        open_run(run, ExportOptions())  # before minutes of tracking, if it is none
    velodyne = dataset.velodyne()
    if len(velodyne.paths) < 2:
        raise DatasetError(
            f"{next(iter(velodyne.paths.values()))} is the only scan, need 2 to find a motion"
        )
    folder = _new_folder(out, dataset.info.name)
    start_s = time.perf_counter()
    trajectory = track_camera(velodyne, on_progress)
    report = _describe(dataset, velodyne, trajectory)
    report["seconds_per_scan"] = (time.perf_counter() - start_s) / len(velodyne.paths)
    write_kitti(folder / "trajectory_kitti.txt", trajectory)
    write_tum(folder / "trajectory_tum.txt", trajectory)
    write_report(folder / REPORT_FILE, report)
    if run is not None:
        report["comparison"] = compare_with_run(run, trajectory, velodyne, on_progress)
        write_report(folder / REPORT_FILE, report)
    return LidarReference(folder, trajectory, report)


def track_camera(velodyne: Velodyne, on_progress: Progress = no_progress) -> Trajectory:
    """Find the camera's path by the scans.

    Scans that turned while the car moved are straightened where every frame has one; where
    frames lack scans, the motion during a turn is not known well enough, and stays in.

    Returns:
        ``world_from_cam`` of the frames that have scans, metres; the first is the identity.

    Raises:
        DatasetError: a scan is broken.
        DependencyError: KISS-ICP is not installed.
    """
    frames = np.array(list(velodyne.paths), np.int64)
    straightens = straightened(velodyne)
    if not (straightens or velodyne.is_compensated):
        logger.info("some frames lack scans: the motion during a turn of the scanner stays in")
    poses = []
    with closing(
        read_ahead(partial(_read, velodyne, int(f), straightens) for f in frames)
    ) as scans:
        for pose in track_scans(scans):
            poses.append(pose)
            on_progress("tracking scans", len(poses), len(frames))
    first_from_scanner = np.stack(poses)
    if straightens:
        first_from_scanner = half_a_turn_before(first_from_scanner)
    cam_from_velo = velodyne.rig.cam_from_velo
    any_from_cam = first_from_scanner @ np.linalg.inv(cam_from_velo)
    world_from_cam = np.linalg.inv(any_from_cam[0]) @ any_from_cam
    return Trajectory(frames, velodyne.times_s[frames], world_from_cam)


def half_a_turn_before(first_from_scanner: Array) -> Array:
    """Move poses at the end of each turn of the scanner to its middle, where images are taken.

    KISS-ICP takes the motion during a turn to be that between the two scans before; so the first
    two are left as they were seen, and stay where they are.

    Args:
        first_from_scanner: (N, 4, 4) rigid, of consecutive turns.
    """
    out = first_from_scanner.copy()
    steps = np.linalg.inv(first_from_scanner[:-1]) @ first_from_scanner[1:]
    for row, step in enumerate(steps[:-1], start=2):
        half = interpolate_sim3(Sim3(), Sim3.from_matrix(step), np.array([0.5]))[0]
        out[row] = first_from_scanner[row] @ half.inverse().matrix()
    return out


def straightened(velodyne: Velodyne) -> bool:
    """Tell whether the motion during each turn of the scanner is to be taken out of its scans."""
    if velodyne.is_compensated:
        return False
    gaps = np.diff(list(velodyne.paths))
    if (gaps == 1).all():
        return True
    return False


def _read(velodyne: Velodyne, frame: int, straightens: bool) -> tuple[Array, Array]:
    points = raise_beams(velodyne.points(frame))
    return points, turn_shares(points) if straightens else np.empty(0)


def _describe(dataset: LidarDataset, velodyne: Velodyne, path: Trajectory) -> dict[str, Any]:
    truth = dataset.info.truth
    return {
        "sequence": dataset.info.name,
        "num_scans": len(velodyne.paths),
        "first_frame": int(path.frames[0]),
        "last_frame": int(path.frames[-1]),
        "path_length_m": float(path_distances(path)[-1]),
        "straightened": straightened(velodyne),
        "kiss_icp": version("kiss-icp"),
        "errors": None if truth is None else evaluate_trajectory(path, truth).numbers(),
    }


def _new_folder(out: Path | None, name: str) -> Path:
    folder = out or new_run_folder(f"{name}-lidar")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise RunFolderError(f"{folder} is not empty; choose another with --out")
    except OSError as error:
        raise RunFolderError(
            f"cannot use {folder}: {error.strerror}; choose another with --out"
        ) from error
    return folder


def summarize_lidar(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Give the lines of a summary: a name, and a value with its unit."""
    yield "scans", f"{report['num_scans']}, path of {report['path_length_m']:.2f} m"
    errors = report["errors"]
    if errors is not None and errors["ate_se3_m"] is not None:
        yield "ATE of LiDAR", f"{errors['ate_se3_m']['rmse']:.3f} m RMSE against the truth"
    compared = report.get("comparison")
    if compared is None:
        return
    scale, spread = compared["scale"], compared["scale"]["by_stretches"]
    band = f" ({spread['p16']:.3f} to {spread['p84']:.3f})" if spread else ""
    yield "metric scale", f"{scale['metres_per_world_unit']:.3f} m per world unit{band}"
    if compared["depth"] is None:
        yield "depth AbsRel", "no keyframe has a scan"
    else:
        yield from _summarize_depth(compared["depth"])
    cloud = compared["cloud"]
    if cloud["median_m"] is not None:
        shares = "/".join(f"{cloud[f'within_{cm}_cm']:.0%}" for cm in (10, 20, 50))
        yield "map to scans", f"median {cloud['median_m']:.3f} m; {shares} within 10/20/50 cm"


def _summarize_depth(depth: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if depth["median_rel"] is None:
        yield "depth AbsRel", "no confident depth where laser points are"
        return
    scores = depth["by_trajectory_scale"]
    yield (
        "depth AbsRel",
        f"{scores['abs_rel']:.3f}, median {depth['median_rel']:.3f}, with the scale of the path; "
        f"{depth['by_median_ratio']['abs_rel']:.3f} with its own",
    )
    yield "", f"over the {scores['coverage']:.0%} of the laser points where depth is confident"
