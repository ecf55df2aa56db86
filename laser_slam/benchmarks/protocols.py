"""Scores that a run's own report does not hold: of every frame's depth, and of its points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import resize_intrinsics, unproject
from laser_slam.datasets.base import Dataset
from laser_slam.evaluation import (
    INDOOR_POINTS,
    OUTDOOR_POINTS,
    VIDEO_DEPTH_PROTOCOLS,
    PointMap,
    PointProtocol,
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
    """A data set's true depth as the run's rectified camera sees it."""

    def __init__(self, folder: Path, dataset: Dataset) -> None:
        self._dataset, self._rectifier = dataset, None
        path = folder / CALIBRATION
        if path.exists():
            calibration = load_calibration(path)
            rectifier = Rectifier(calibration, calibration.size)
            self._rectifier = rectifier if rectifier.bends else None

    def depth(self, frame: int) -> Depth | None:
        """Return a frame's (H, W) z in metres; None: there is none."""
        truth = self._dataset.true_depth(frame)
        if truth is None or self._rectifier is None:
            return truth
        return self._rectifier.depth(truth)

    def intrinsics(self, size: tuple[int, int], seen: Array) -> Array:
        """Return the (3, 3) true ones for maps of (height, width), or ``seen``."""
        info = self._dataset.info
        if self._rectifier is not None or info.intrinsics is None:
            return seen
        return resize_intrinsics(info.intrinsics, info.size, size)


def _video_depth(name: str) -> Protocol:
    def score(folder: Path, dataset: Dataset) -> dict[str, Any]:
        known = _Truth(folder, dataset)
        num = dataset.info.num_frames or 0

        def pairs() -> Iterator[tuple[Depth | None, Depth]]:
            views = _views(folder)
            view = next(views, None)
            for frame in range(num):
                truth, depth = known.depth(frame), None
                if view is not None and view.frame == frame:
                    depth, view = view.depth, next(views, None)
                if truth is not None:
                    yield depth, truth

        return asdict(evaluate_video_depth(pairs, VIDEO_DEPTH_PROTOCOLS[name]))

    return score


def _points(protocol: PointProtocol) -> Protocol:
    def score(folder: Path, dataset: Dataset) -> dict[str, Any]:
        truth = dataset.info.truth
        if truth is None:
            return {"reason": "no true poses"}
        poses = dict(zip(truth.frames.tolist(), truth.world_from_cam, strict=True))
        known = _Truth(folder, dataset)

        def maps() -> Iterator[PointMap]:
            for view in _views(folder):
                depth = known.depth(view.frame)
                if depth is not None and view.frame in poses:
                    size = (view.depth.shape[0], view.depth.shape[1])
                    K = known.intrinsics(size, view.intrinsics)
                    yield PointMap(
                        _unproject(view.depth, view.intrinsics, view.world_from_cam),
                        _unproject(_resized(depth, size), K, poses[view.frame]),
                        view.confidence,
                    )

        return asdict(evaluate_points(maps(), protocol))

    return score


def _resized(depth: Depth, size: tuple[int, int]) -> Depth:
    """Take the nearest pixels: means over depth edges would be no truth."""
    rows, columns = (_nearest(new, old) for new, old in zip(size, depth.shape, strict=True))
    return depth[np.ix_(rows, columns)]


def _nearest(num: int, of: int) -> NDArray[np.int64]:
    return np.clip(((np.arange(num) + 0.5) * of / num).astype(np.int64), 0, of - 1)


def _unproject(depth: Depth, K: Array, world_from_cam: Array) -> Array:
    """Return (H, W, 3) world points; NaN: unknown."""
    in_cam = unproject(depth, K)
    return np.asarray(Sim3.from_matrix(world_from_cam).apply(in_cam.reshape(-1, 3))).reshape(
        *depth.shape, 3
    )


PROTOCOLS: dict[str, Protocol] = {
    **{f"video_depth_{name}": _video_depth(name) for name in VIDEO_DEPTH_PROTOCOLS},
    "points_indoor": _points(INDOOR_POINTS),
    "points_outdoor": _points(OUTDOOR_POINTS),
}
"""Name -> scores of a finished run; their ``reason`` says why there are none."""
