"""What a finished run leaves: scores against the truth, files, pictures, the report."""

from __future__ import annotations

import json
import math
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam import __version__
from laser_slam.evaluation.depth import evaluate_depth
from laser_slam.evaluation.trajectory import TrajectoryErrors, align
from laser_slam.export import write_kitti, write_tum
from laser_slam.report import (
    CloudView,
    cloud_picture,
    depth_picture,
    drift_picture,
    trajectory_picture,
)
from laser_slam.slam import Node
from laser_slam.store import write_text
from laser_slam.types import Calibration, Cloud, Image, Prediction, SequenceInfo, Trajectory

Array = NDArray[np.float64]

PACKAGES = ("numpy", "numba", "opencv-python-headless", "open3d", "poselib", "scipy")
NUM_DRAWN = 4  # keyframes on the picture of depths
Load = Callable[[int], tuple[Prediction, Image]]


@dataclass(frozen=True)
class Results:
    """What a run gives.

    Attributes:
        folder: where all of it lies.
        trajectory: a pose for every frame of the input.
        cloud: the map, in world units.
        report: all numbers, as in ``report.json``.
    """

    folder: Path
    trajectory: Trajectory
    cloud: Cloud
    report: dict[str, Any]


@dataclass(frozen=True)
class KeyframeView:
    """What a run says of one keyframe.

    Attributes:
        frame: index in the sequence.
        image: (H, W, 3) RGB.
        depth: (H, W) in world units; NaN: unknown.
        confidence: (H, W) in [0, 1].
    """

    frame: int
    image: Image
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]


@dataclass(frozen=True)
class Scores:
    """What the truth says of a run; None where there is none.

    Attributes:
        trajectory: errors of the frames' poses.
        depth: errors of the keyframes' depth, as in the report.
        views: the keyframes that were looked at.
    """

    trajectory: TrajectoryErrors | None
    depth: dict[str, Any] | None
    views: Sequence[KeyframeView]


def describe_sequence(
    info: SequenceInfo, calibration: Calibration, intrinsics: Sequence[Array]
) -> dict[str, Any]:
    """Describe the input, and with which calibration it was taken.

    Args:
        info: what the data set knows.
        calibration: what the run took for the camera, lens included.
        intrinsics: (3, 3) of each window, in pixels of rectified images, as the backbone used them.
    """
    return {
        "name": info.name,
        "height": info.size[0],
        "width": info.size[1],
        "has_truth": info.truth is not None,
        "intrinsics": _four_numbers(np.median(intrinsics, axis=0)),
        "intrinsics_given": None if info.intrinsics is None else _four_numbers(info.intrinsics),
        "intrinsics_source": info.intrinsics_source,
        "calibration": calibration.source,
        "distortion": [round(float(k), 6) for k in calibration.distortion],
    }


def _four_numbers(intrinsics: Array) -> dict[str, float]:
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return {name: round(float(intrinsics[place]), 4) for name, place in places.items()}


def sample_views(nodes: Sequence[Node], load: Load, num: int) -> Iterator[KeyframeView]:
    """Take up to ``num`` keyframes with depth, spread evenly over the run.

    Args:
        nodes: the places of all windows.
        load: gives a window's prediction and colours by its index.
        num: how many.
    """
    owned = [(node, i) for node in nodes for i in np.flatnonzero(node.is_owned)]
    chosen = np.unique(np.linspace(0, len(owned) - 1, min(num, len(owned))).round().astype(int))
    index = -1
    for node, i in (owned[k] for k in chosen):
        if node.index != index:
            index = node.index
            prediction, colors = load(index)
        depth = prediction.depth[i] * np.float32(node.world_from_window.scale)
        if np.isfinite(depth).any():
            yield KeyframeView(int(node.frames[i]), colors[i], depth, prediction.confidence[i])


def score_depth(
    views: Sequence[KeyframeView],
    true_depth: Callable[[int], NDArray[np.float32] | None],
    metres_per_unit: float | None,
    min_confidence: float,
) -> dict[str, Any] | None:
    """Compare the confident depth of keyframes with the truth, all with one scale.

    Args:
        views: keyframes of the run.
        true_depth: gives a frame's (H, W) truth in metres, or None.
        metres_per_unit: the scale of the trajectory's Sim(3) alignment; None: there is none.
        min_confidence: pixels below it are not compared.

    Returns:
        The scores with the scale of the trajectory and with the median of the depth ratios;
        None: no truth.
    """
    depths, truths, masks = [], [], []
    for view in views:
        truth = true_depth(view.frame)
        if truth is not None:
            depths.append(view.depth)
            truths.append(_nearest(truth, view.depth.shape))
            masks.append(view.confidence >= min_confidence)
    if not truths:
        return None
    scores: dict[str, Any] = {"num_keyframes": len(truths), "min_confidence": min_confidence}
    scores["by_median_ratio"] = asdict(evaluate_depth(depths, truths, masks))
    scores["by_trajectory_scale"] = None
    if metres_per_unit is not None:
        metric = [depth * np.float32(metres_per_unit) for depth in depths]
        scaled = replace(evaluate_depth(metric, truths, masks, "none"), scale=metres_per_unit)
        scores["by_trajectory_scale"] = asdict(scaled)
    return scores


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


def draw_map(pictures: Path, trajectory: Trajectory, cloud: Cloud) -> None:
    """Draw the cloud from all sides that a person would look from.

    Raises:
        RunFolderError: a picture cannot be written.
    """
    for view in CloudView:
        cloud_picture(pictures / f"map_{view.value}.png", cloud, trajectory, view)


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


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report as JSON; what is not a number becomes null, for JSON knows no NaN.

    Raises:
        RunFolderError: the file cannot be written.
    """
    write_text(path, json.dumps(_without_nan(report), indent=2, ensure_ascii=False) + "\n")


def versions() -> dict[str, str]:
    """Name what the results may depend on."""
    out = {"laser-slam": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            continue
    return {**out, "system": platform.platform()}


def peak_memory_mib() -> float | None:
    """Return the largest memory that this process had so far; None where the system can't tell."""
    try:
        import resource  # noqa: PLC0415  (not on every system)
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _without_nan(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _nearest(image: NDArray[np.float32], size: tuple[int, ...]) -> NDArray[np.float32]:
    """Take the nearest pixel's value: averages over depth edges would be no truth."""
    rows, columns = (
        np.clip(((np.arange(new) + 0.5) * old / new).astype(int), 0, old - 1)
        for new, old in zip(size, image.shape, strict=True)
    )
    return image[np.ix_(rows, columns)]
