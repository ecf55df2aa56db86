"""The files of a finished run: trajectories and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from laser_slam.evaluation.trajectory import TrajectoryErrors, align
from laser_slam.export import write_kitti, write_tum
from laser_slam.report import (
    CloudView,
    cloud_picture,
    depth_picture,
    drift_picture,
    layers_picture,
    mismatch_picture,
    trajectory_picture,
)
from laser_slam.results.scores import KeyframeView
from laser_slam.slam import Node
from laser_slam.types import Cloud, Trajectory

NUM_DRAWN = 4  # keyframes on the picture of depths


def write_trajectories(folder: Path, trajectory: Trajectory, truth: Trajectory | None) -> None:
    """Write the trajectory in KITTI's and TUM's formats, and the truth beside it, in metres.

    Raises:
        RunFolderError: a file cannot be written.
    """
    write_kitti(folder / "trajectory_kitti.txt", trajectory)
    write_tum(folder / "trajectory_tum.txt", trajectory)
    if truth is not None:
        write_tum(folder / "truth_tum.txt", truth)


def draw_trajectory(
    pictures: Path,
    trajectory: Trajectory,
    truth: Trajectory | None,
    errors: TrajectoryErrors | None,
) -> None:
    """Draw the path from above, on the truth where there is one, and its drift.

    Raises:
        RunFolderError: a picture cannot be written.
    """
    if truth is None or errors is None or errors.scale is None:
        trajectory_picture(pictures / "trajectory.png", trajectory, None)
        return
    truth_from_world = align(trajectory, truth, with_scale=True)
    aligned = replace(
        trajectory, world_from_cam=truth_from_world.apply_poses(trajectory.world_from_cam)
    )
    trajectory_picture(pictures / "trajectory.png", aligned, truth)
    drift_picture(pictures / "drift.png", errors.distances_m, errors.drift_m)


def draw_map(
    pictures: Path, trajectory: Trajectory, cloud: Cloud, unfiltered: Cloud | None = None
) -> None:
    """Draw the cloud from all sides that a person would look from.

    Args:
        pictures: folder of the files to be.
        trajectory: a pose for every frame.
        cloud: the map, in world units.
        unfiltered: what it would be without filters, drawn from the same places; None: it is not.

    Raises:
        RunFolderError: a picture cannot be written.
    """
    for view in CloudView:
        path = pictures / f"map_{view.value}.png"
        cloud_picture(path, cloud, trajectory, view)
        if unfiltered is not None:
            path = pictures / f"map_{view.value}_unfiltered.png"
            cloud_picture(path, unfiltered, trajectory, view, like=cloud)


def draw_depth(pictures: Path, views: Sequence[KeyframeView]) -> None:
    """Draw image, depth and confidence of a few keyframes; nothing where there are none.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    if views:
        rows = np.unique(np.linspace(0, len(views) - 1, NUM_DRAWN).round().astype(int))
        shown = [views[row] for row in rows]
        depth_picture(
            pictures / "depth.png",
            [view.image for view in shown],
            [view.depth for view in shown],
            [view.confidence for view in shown],
        )


def draw_layers(pictures: Path, views: Sequence[KeyframeView], nodes: Sequence[Node]) -> None:
    """Draw layers and their scales of a few keyframes, and how well neighbouring windows agree.

    Nothing is drawn where layers were not looked at.

    Raises:
        RunFolderError: a picture cannot be written.
    """
    seen = [view for view in views if view.labels is not None]
    if not seen:
        return
    rows = np.unique(np.linspace(0, len(seen) - 1, NUM_DRAWN).round().astype(int))
    shown = [seen[row] for row in rows]
    layers_picture(
        pictures / "layers.png",
        [view.image for view in shown],
        [view.labels for view in shown if view.labels is not None],
        [view.depth / view.raw_depth for view in shown],
    )
    counts = {node.index: node.layers for node in nodes if node.layers is not None}
    measured = {i: c for i, c in counts.items() if c.mismatch_before is not None}
    if measured:
        mismatch_picture(
            pictures / "layer_mismatch.png",
            list(measured),
            [c.mismatch_before or 0.0 for c in measured.values()],
            [c.mismatch_after or 0.0 for c in measured.values()],
        )
