"""Compare a finished run with the laser scans of its sequence."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.bookkeeping import Progress, no_progress
from laser_slam.config import Config, load_config
from laser_slam.datasets.velodyne import Velodyne
from laser_slam.dependencies import num_threads
from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation import evaluate_depth, evaluate_trajectory
from laser_slam.evaluation.clouds import ScanDistances
from laser_slam.evaluation.trajectory import common_frames, path_distances
from laser_slam.export import DepthView
from laser_slam.exporting import ExportOptions
from laser_slam.exporting.run import open_run
from laser_slam.rectification import Rectifier
from laser_slam.results import TILES
from laser_slam.sim3 import Sim3, umeyama
from laser_slam.store import TileFiles
from laser_slam.store.keyframes import load_originals
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

MOST_POINTS = 300_000  # of the map, evenly taken
SCANS_APART_M = 0.5  # scans from nearer together say the same of the map
MIN_PATH_M = 1.0  # a shorter path has no scale
STRETCH_M = 1.0  # the least length over which a scale is measured
MOST_STRETCHES = 20
RANGES_M = (0, 10, 20, 40, 120)


def compare_with_run(
    run: Path, lidar: Trajectory, velodyne: Velodyne, on_progress: Progress = no_progress
) -> dict[str, Any]:
    """Judge path, depth and map of a run by the scans of its sequence.

    Args:
        run: folder of a finished run over the same frames.
        lidar: ``world_from_cam`` of the frames that have scans, metres.
        velodyne: the scans.
        on_progress: called with a stage's name, how much is done and of how much.

    Returns:
        ``scale``: metres per world unit, by the path and by the depth, with percentiles 16 and
        84 of its parts; ``trajectory``, ``depth`` and ``cloud``: errors in metres.

    Raises:
        RunFolderError: no finished run is there, or a file of it is damaged.
        DatasetError: a scan is broken.
        DegenerateGeometryError: run and scans have no motion in common.
    """
    source = open_run(run, ExportOptions())
    lidar_from_world = align_cameras(source.trajectory, lidar)
    config = load_config(None, run / "config.yaml")
    scale = lidar_from_world.scale
    compared = _DepthComparison(run, velodyne, config)
    depth, by_depth = compared.errors(source.views(set(velodyne.paths)), scale)
    return {
        "run": str(run),
        "scale": {
            "metres_per_world_unit": scale,
            "by_stretches": _percentiles(stretch_scales(source.trajectory, lidar)),
            "by_depth_of_keyframes": _percentiles(by_depth),
        },
        "trajectory": evaluate_trajectory(source.trajectory, lidar).numbers(),
        "depth": depth,
        "cloud": _compare_cloud(run, lidar_from_world, lidar, velodyne, on_progress),
    }


def align_cameras(estimate: Trajectory, lidar: Trajectory) -> Sim3:
    """Find the similarity between two paths by the places and the headings of their cameras.

    The places alone leave a straight path free to roll. Each camera stands for its centre and
    the ends of its axes, as long as the path is wide.

    Args:
        estimate: in world units.
        lidar: in metres, of some of its frames.

    Returns:
        ``lidar_from_world``; its scale is metres per world unit.

    Raises:
        DegenerateGeometryError: fewer than 2 common frames, or one of the paths is a point.
    """
    estimate, lidar = common_frames(estimate, lidar)
    if len(lidar.frames) < 2:
        raise DegenerateGeometryError(
            f"run and scans have {len(lidar.frames)} frames in common, need 2"
        )
    path_m = float(path_distances(lidar)[-1])
    if path_m < MIN_PATH_M:
        raise DegenerateGeometryError(
            f"the scanner moved {path_m:.2f} m, need {MIN_PATH_M:g} m to measure a scale"
        )
    return umeyama(_anchors(estimate.world_from_cam), _anchors(lidar.world_from_cam))


def _anchors(world_from_cam: Array) -> Array:
    """Return (7 N, 3) points that stand for N cameras."""
    centers = world_from_cam[:, :3, 3]
    length = np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean())
    if length <= 1e-9 * max(float(np.abs(centers).max()), 1e-300):
        raise DegenerateGeometryError("the run's path stays in one place: it has no scale")
    axes = length * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = centers[:, None] + axes @ np.swapaxes(world_from_cam[:, :3, :3], 1, 2)
    return np.asarray(points.reshape(-1, 3))


def stretch_scales(estimate: Trajectory, lidar: Trajectory) -> Array:
    """Return (K,) metres per world unit of up to ``MOST_STRETCHES`` even stretches of the path."""
    estimate, lidar = common_frames(estimate, lidar)
    distances = path_distances(lidar)
    num = int(np.clip(distances[-1] / STRETCH_M, 1, MOST_STRETCHES))
    ends = np.unique(np.searchsorted(distances, np.linspace(0, distances[-1], num + 1)))
    moved, true = (
        np.linalg.norm(np.diff(path.world_from_cam[ends, :3, 3], axis=0), axis=1)
        for path in (estimate, lidar)
    )
    return np.asarray(true[moved > 0] / moved[moved > 0])


def _percentiles(values: Array) -> dict[str, float | int] | None:
    if not len(values):
        return None
    names, found = ("p16", "median", "p84"), np.percentile(values, [16, 50, 84])
    return {**{name: float(v) for name, v in zip(names, found, strict=True)}, "num": len(values)}


class _DepthComparison:
    """Depth of a run's keyframes against that of their scans."""

    def __init__(self, run: Path, velodyne: Velodyne, config: Config) -> None:
        self._calibration = load_originals(run).calibration
        self._velodyne = velodyne
        self._least = config.fusion.min_confidence

    def errors(
        self, views: Iterator[DepthView], metres_per_unit: float
    ) -> tuple[dict[str, Any] | None, Array]:
        """Compare confident depth, all with one scale; None: no keyframe has a scan.

        Returns:
            The scores, ``median_rel`` being the middle error with the scale given, and
            ``by_range`` the same for some distances; and metres per world unit by the median
            ratio of each keyframe.
        """
        pairs = [self._pixels(view) for view in views]
        if not pairs:
            return None, np.empty(0)
        depths, truths, masks = (list(part) for part in zip(*pairs, strict=True))
        metric = [depth * np.float32(metres_per_unit) for depth in depths]
        by_path = evaluate_depth(metric, truths, masks, "none")
        ratios = [truth[used] / depth[used] for depth, truth, used in pairs if used.any()]
        misfits = np.abs(metres_per_unit / np.concatenate([np.empty(0), *ratios]) - 1)
        ranges_m = np.concatenate([np.empty(0), *(truth[used] for _, truth, used in pairs)])
        scores = {
            "num_keyframes": len(pairs),
            "min_confidence": self._least,
            "median_rel": float(np.median(misfits)) if len(misfits) else None,
            "by_range": list(_by_range(misfits, ranges_m)),
            "by_trajectory_scale": asdict(replace(by_path, scale=metres_per_unit)),
            "by_median_ratio": asdict(evaluate_depth(depths, truths, masks)),
        }
        return scores, np.array([float(np.median(ratio)) for ratio in ratios])

    def _pixels(
        self, view: DepthView
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """Take the pixels that have a laser point: depth, truth, and where depth is sure."""
        truth = self._velodyne.depth(view.frame)
        assert truth is not None  # only frames with scans were asked for
        size = (view.depth.shape[0], view.depth.shape[1])
        truth = Rectifier(self._calibration, size).depth(truth)
        rows = np.isfinite(truth)
        depth = view.depth[rows]
        return depth, truth[rows], (view.confidence[rows] >= self._least) & (depth > 0)


def _by_range(misfits: Array, ranges_m: Array) -> Iterator[dict[str, float | int]]:
    """Give the middle relative error between one distance and the next, where there are pixels."""
    for near_m, far_m in pairwise(RANGES_M):
        chosen = misfits[(ranges_m >= near_m) & (ranges_m < far_m)]
        if len(chosen):
            median = float(np.median(chosen))
            yield {
                "from_m": near_m,
                "to_m": far_m,
                "median_rel": median,
                "num_pixels": len(chosen),
            }


def _compare_cloud(
    run: Path, lidar_from_world: Sim3, lidar: Trajectory, velodyne: Velodyne, watch: Progress
) -> dict[str, Any]:
    cloud = TileFiles(run / TILES).cloud(MOST_POINTS)
    distances = ScanDistances(lidar_from_world.apply(cloud.points))
    chosen = _spaced(lidar, set(velodyne.paths))
    for done, row in enumerate(chosen, start=1):
        world_from_scanner = lidar.world_from_cam[row] @ velodyne.rig.cam_from_velo
        scan = velodyne.points(int(lidar.frames[row]))
        distances.add(world_from_scanner, scan, num_threads())
        watch("comparing the map", done, len(chosen))
    return {
        **asdict(distances.errors()),
        "num_scans": len(chosen),
        "voxel_size_m": cloud.voxel_size * lidar_from_world.scale,
    }


def _spaced(lidar: Trajectory, frames: Collection[int]) -> list[int]:
    """Choose rows of scans that are not all taken from the same place."""
    rows: list[int] = []
    last_m = -np.inf
    for row, at_m in enumerate(path_distances(lidar)):
        if int(lidar.frames[row]) in frames and at_m - last_m >= SCANS_APART_M:
            rows.append(row)
            last_m = at_m
    return rows
