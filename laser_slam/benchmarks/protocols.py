"""Scores that a run's own report does not hold: of every frame's depth, and of its points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.benchmarks.truth import (
    TruePoints,
    exact_points,
    room_points,
    seven_scenes_points,
    street_points,
)
from laser_slam.camera import resize_intrinsics, unproject
from laser_slam.datasets.base import Dataset
from laser_slam.evaluation import (
    INDOOR_POINTS,
    OUTDOOR_POINTS,
    VIDEO_DEPTH_PROTOCOLS,
    PointMap,
    PointProtocol,
    VideoDepthProtocol,
    comparable_depth,
    evaluate_points,
    evaluate_video_depth,
)
from laser_slam.export import DepthView
from laser_slam.exporting.options import ExportOptions
from laser_slam.exporting.run import open_run
from laser_slam.rectification import Rectifier, load_calibration
from laser_slam.sim3 import Sim3

Depth = NDArray[np.float32]
Array = NDArray[np.float64]
Protocol = Callable[[Path, Dataset], dict[str, Any]]

CALIBRATION = "calibration.yaml"


def _views(folder: Path) -> Iterator[DepthView]:
    """Read the keyframes of a finished run in order, depth in world units."""
    return iter(open_run(folder, ExportOptions()).views(None))


class _Truth:
    """A data set's true depth as the run's rectified camera sees it.

    Args:
        folder: of the run.
        dataset: that it was run on.
        keep: chooses what of a map is compared, before anything is done to it.
    """

    def __init__(
        self, folder: Path, dataset: Dataset, keep: Callable[[Depth], Depth] = np.asarray
    ) -> None:
        self._dataset, self._keep, self._rectifier = dataset, keep, None
        path = folder / CALIBRATION
        if path.exists():
            calibration = load_calibration(path)
            rectifier = Rectifier(calibration, calibration.size)
            self._rectifier = rectifier if rectifier.bends else None

    def depth(self, frame: int) -> Depth | None:
        """Return a frame's (H, W) z in metres; None: there is none."""
        truth = self._dataset.true_depth(frame)
        if truth is None:
            return None
        kept = self._keep(truth)
        return kept if self._rectifier is None else self._rectifier.depth(kept)

    def intrinsics(self, depth: Depth, view: DepthView) -> Array:
        """Return the (3, 3) of a frame's true depth: the true ones, or those it is rectified to."""
        info = self._dataset.info
        size = depth.shape[0], depth.shape[1]
        if self._rectifier is not None or info.intrinsics is None:
            seen = view.depth.shape[0], view.depth.shape[1]
            return resize_intrinsics(view.intrinsics, seen, size)
        return resize_intrinsics(info.intrinsics, info.size, size)


def _video_depth(protocol: VideoDepthProtocol) -> Protocol:
    def score(folder: Path, dataset: Dataset) -> dict[str, Any]:
        known = _Truth(folder, dataset)

        def pairs() -> Iterator[tuple[Depth | None, Depth]]:
            for frame, view in _every_frame(folder, dataset):
                truth = known.depth(frame)
                if truth is not None:
                    yield None if view is None else view.depth, truth

        return asdict(evaluate_video_depth(pairs, protocol))

    return score


def _points(protocol: PointProtocol, true_points: TruePoints = exact_points) -> Protocol:
    def score(folder: Path, dataset: Dataset) -> dict[str, Any]:
        if dataset.info.truth is None:
            return {"reason": "no true poses"}
        if dataset.info.intrinsics is None:  # those of the run would make it its own judge
            return {"reason": "the intrinsics of the true depth are unknown"}
        if next(_views(folder), None) is None:
            return {"reason": "the run has no depth map"}
        known = _Truth(folder, dataset, partial(comparable_depth, protocol=protocol))
        maps = _point_maps(folder, dataset, known, true_points)
        return asdict(evaluate_points(maps, protocol))

    return score


def _point_maps(
    folder: Path, dataset: Dataset, known: _Truth, true_points: TruePoints
) -> Iterator[PointMap]:
    """Give the points of every frame whose true depth and pose are known; NaN: not predicted."""
    poses = _true_poses(dataset)
    like = next(_views(folder))  # frames that the run has no view of are given in its size
    size = (like.depth.shape[0], like.depth.shape[1])
    for frame, view in _every_frame(folder, dataset):
        depth = known.depth(frame) if frame in poses else None
        if depth is None:
            continue
        in_cam = true_points(depth, known.intrinsics(depth, view or like), size)
        truth = _placed(in_cam, poses[frame])
        if view is None:
            yield PointMap(np.full_like(truth, np.nan), truth, np.zeros(size, np.float32))
        else:
            found = _placed(unproject(view.depth, view.intrinsics), view.world_from_cam)
            yield PointMap(found, truth, view.confidence)


def _every_frame(folder: Path, dataset: Dataset) -> Iterator[tuple[int, DepthView | None]]:
    """Give each frame of a data set with the run's view of it; None: it has none."""
    views = _views(folder)
    view = next(views, None)
    for frame in range(dataset.info.num_frames or 0):
        found = view if view is not None and view.frame == frame else None
        yield frame, found
        if found is not None:
            view = next(views, None)


def _true_poses(dataset: Dataset) -> dict[int, Array]:
    truth = dataset.info.truth
    if truth is None:
        return {}
    return dict(zip(truth.frames.tolist(), truth.world_from_cam, strict=True))


def _placed(in_cam: Array, world_from_cam: Array) -> Array:
    """Return (H, W, 3) world points; NaN: unknown."""
    moved = Sim3.from_matrix(world_from_cam).apply(in_cam.reshape(-1, 3))
    return np.asarray(moved).reshape(in_cam.shape)


PROTOCOLS: dict[str, Protocol] = {
    **{f"video_depth_{name}": _video_depth(each) for name, each in VIDEO_DEPTH_PROTOCOLS.items()},
    "points_indoor": _points(INDOOR_POINTS),
    "points_outdoor": _points(OUTDOOR_POINTS),
    "points_7scenes": _points(INDOOR_POINTS, seven_scenes_points),
    "points_nrgbd": _points(INDOOR_POINTS, room_points),
    "points_waymo": _points(OUTDOOR_POINTS, street_points),
}
"""Name -> scores of a finished run; their ``reason`` says why there are none."""
