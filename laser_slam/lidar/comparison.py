"""Compare a finished run with the laser scans of its sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.bookkeeping import Progress, identify, no_progress
from laser_slam.config import load_config
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.velodyne import Velodyne
from laser_slam.errors import RunFolderError
from laser_slam.evaluation import evaluate_trajectory
from laser_slam.export import Source
from laser_slam.exporting import ExportOptions
from laser_slam.exporting.run import open_run
from laser_slam.lidar.alignment import align_pieces, stretch_scales
from laser_slam.lidar.depth import ScannedPixels
from laser_slam.lidar.surfaces import MOST_POINTS, compare_surfaces
from laser_slam.predicting.manifest import read_identity
from laser_slam.report import trajectory_picture
from laser_slam.results import TILES
from laser_slam.sim3 import Sim3
from laser_slam.store import TileFiles
from laser_slam.store.files import write_text
from laser_slam.store.keyframes import load_keyframes, load_originals
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

TRANSFORM_FILE, PATHS_PICTURE = "metric_from_world.txt", "trajectory.png"


def refuse_other_input(run: Path, dataset: Dataset) -> None:
    """Make sure that a run is finished, and over the images of a data set.

    Raises:
        RunFolderError: it is not.
        DatasetError: the first image cannot be read.
    """
    open_run(run, ExportOptions())
    stored, wanted = read_identity(run), identify(dataset)
    keys = ("size", "num_frames", "first_image_crc32")
    if _some(stored, keys) != _some(wanted, keys):
        raise RunFolderError(
            f"the run in {run} is over other images ({stored.get('name')}, "
            f"{stored.get('num_frames')} frames) than those beside the scans ({wanted['name']}, "
            f"{wanted['num_frames']} frames); give a run over the same folder"
        )


def _some(identity: Mapping[str, Any], keys: tuple[str, ...]) -> list[Any]:
    return [identity.get(key) for key in keys]


def compare_with_run(
    run: Path,
    lidar: Trajectory,
    velodyne: Velodyne,
    folder: Path,
    on_progress: Progress = no_progress,
) -> dict[str, Any]:
    """Judge path, depth and map of a run by the scans of its sequence.

    Args:
        run: folder of a finished run over the same frames.
        lidar: ``world_from_cam`` of the frames that have scans, metres.
        velodyne: the scans.
        folder: gets clouds and pictures, and ``metric_from_world.txt``, the similarity from the
            run's world to the metric one.
        on_progress: called with a stage's name, how much is done and of how much.

    Returns:
        ``scale``: metres per world unit, by the path and by the depth, with percentiles 16 and
        84 of its parts; ``trajectory``, ``depth`` and ``cloud``: errors in metres.

    Raises:
        RunFolderError: no finished run is there, a file of it is damaged, or one cannot be written.
        DatasetError: a scan is broken.
        DegenerateGeometryError: run and scans have no motion in common.
    """
    opened = open_run(run, ExportOptions())
    path = opened.trajectory
    pieces = align_pieces(path, lidar)
    lidar_from_world = pieces.whole
    _write_transform(folder / TRANSFORM_FILE, lidar_from_world)
    placed = replace(path, world_from_cam=lidar_from_world.apply_poses(path.world_from_cam))
    trajectory_picture(folder / PATHS_PICTURE, placed, lidar)
    pixels = _scanned_pixels(run, opened, velodyne, on_progress)
    unit_m = lidar_from_world.scale
    cloud = TileFiles(run / TILES).cloud(MOST_POINTS)
    return {
        "run": str(run),
        "scale": {
            "metres_per_world_unit": unit_m,
            "by_stretches": _percentiles(stretch_scales(path, lidar)),
            "by_depth_of_keyframes": _percentiles(pixels.ratios()),
        },
        "trajectory": evaluate_trajectory(path, lidar).numbers(),
        "depth": pixels.scores(unit_m, lambda frame: pieces.at(frame).scale),
        "cloud": compare_surfaces(
            cloud, lidar_from_world, pieces, (velodyne, lidar), folder, on_progress
        ),
    }


def _scanned_pixels(
    run: Path, opened: Source, velodyne: Velodyne, watch: Progress
) -> ScannedPixels:
    """Read the depth of the keyframes that have a scan."""
    keyframes = set(load_keyframes(run).frames.tolist()) & set(velodyne.paths)
    config = load_config(None, run / "config.yaml")
    calibration = load_originals(run).calibration
    pixels = ScannedPixels(velodyne, calibration, config.fusion.min_confidence)
    for done, view in enumerate(opened.views(keyframes), start=1):
        pixels.add(view, len(keyframes))
        watch("comparing depth", done, len(keyframes))
    return pixels


def _write_transform(path: Path, lidar_from_world: Sim3) -> None:
    rows = lidar_from_world.matrix()
    write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows))


def _percentiles(values: Array) -> dict[str, float | int] | None:
    if not len(values):
        return None
    names, found = ("p16", "median", "p84"), np.percentile(values, [16, 50, 84])
    return {**{name: float(v) for name, v in zip(names, found, strict=True)}, "num": len(values)}
