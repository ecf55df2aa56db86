"""Scores that a run's own report does not hold: of every frame's depth, and of its points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
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
Size = tuple[int, int]
Protocol = Callable[[Path, Dataset], dict[str, Any]]
Camera = Callable[[Array, Size, Size], Array]
"""Intrinsics, size of the images and size of the map -> intrinsics of the map."""

CALIBRATION = "calibration.yaml"
PUBLISHED_SIZE = (392, 518)  # (height, width) of the truth that published maps of rooms meet
FOCAL_READ_AS = 554.2562584220408 / 525  # 7-Scenes: the evaluation's focal length and the depth's


def _views(folder: Path) -> Iterator[DepthView]:
    """Read the keyframes of a finished run in order, depth in world units."""
    return iter(open_run(folder, ExportOptions()).views(None))


class _Truth:
    """A data set's true depth as the run's rectified camera sees it.

    Args:
        folder: of the run.
        dataset: that it was run on.
        keep: chooses what of a map is compared, before anything is done to it.
        bend: changes true intrinsics for a size as an evaluation does; None: it takes them as
            they are.
    """

    def __init__(
        self,
        folder: Path,
        dataset: Dataset,
        keep: Callable[[Depth], Depth] = np.asarray,
        bend: Camera | None = None,
    ) -> None:
        self._dataset, self._keep, self._bend, self._rectifier = dataset, keep, bend, None
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

    def intrinsics(self, size: Size, seen: Array) -> Array:
        """Return the (3, 3) true ones for maps of (height, width), or ``seen`` if rectified."""
        info = self._dataset.info
        if self._rectifier is not None or info.intrinsics is None:
            return seen
        if self._bend is not None:
            return self._bend(info.intrinsics, info.size, size)
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


def _points(protocol: PointProtocol, bend: Camera | None = None) -> Protocol:
    def score(folder: Path, dataset: Dataset) -> dict[str, Any]:
        if dataset.info.truth is None:
            return {"reason": "no true poses"}
        if dataset.info.intrinsics is None:  # those of the run would make it its own judge
            return {"reason": "the intrinsics of the true depth are unknown"}
        if next(_views(folder), None) is None:
            return {"reason": "the run has no depth map"}
        known = _Truth(folder, dataset, partial(comparable_depth, protocol=protocol), bend)
        return asdict(evaluate_points(_point_maps(folder, dataset, known), protocol))

    return score


def _point_maps(folder: Path, dataset: Dataset, known: _Truth) -> Iterator[PointMap]:
    """Give the points of every frame whose true depth and pose are known; NaN: not predicted."""
    poses = _true_poses(dataset)
    like = next(_views(folder))  # frames that the run has no view of are given in its size
    size = (like.depth.shape[0], like.depth.shape[1])
    for frame, view in _every_frame(folder, dataset):
        depth = known.depth(frame) if frame in poses else None
        if depth is None:
            continue
        K = known.intrinsics(size, (view or like).intrinsics)
        truth = _unproject(_resized(depth, size), K, poses[frame])
        if view is None:
            yield PointMap(np.full_like(truth, np.nan), truth, np.zeros(size, np.float32))
        else:
            found = _unproject(view.depth, view.intrinsics, view.world_from_cam)
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


def published_camera(intrinsics: Array, size: Size, new_size: Size, focal_as: float) -> Array:
    """Return the camera with which pi3's and LASER's evaluations unproject the truth of rooms.

    It belongs to maps of ``PUBLISHED_SIZE``. Both axes are scaled with the larger of the two
    factors, and the focal length of 7-Scenes is that of NRGBD: the truth is bent, and a perfect
    map has errors. Whoever is compared with their numbers must meet the same truth.

    Args:
        intrinsics: (3, 3) of the true depth.
        size: (height, width) of it.
        new_size: (height, width) of the map.
        focal_as: what the focal length is multiplied with.
    """
    factor = max(new / old for new, old in zip(PUBLISHED_SIZE, size, strict=True))
    bent = np.array(intrinsics, np.float64)
    bent[[0, 1], [0, 1]] *= factor * focal_as
    bent[:2, 2] = (bent[:2, 2] + 0.5) * factor - 0.5
    return resize_intrinsics(bent, PUBLISHED_SIZE, new_size)


def _resized(depth: Depth, size: Size) -> Depth:
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
    **{f"video_depth_{name}": _video_depth(each) for name, each in VIDEO_DEPTH_PROTOCOLS.items()},
    "points_indoor": _points(INDOOR_POINTS),
    "points_7scenes": _points(INDOOR_POINTS, partial(published_camera, focal_as=FOCAL_READ_AS)),
    "points_nrgbd": _points(INDOOR_POINTS, partial(published_camera, focal_as=1.0)),
    "points_outdoor": _points(OUTDOOR_POINTS),
}
"""Name -> scores of a finished run; their ``reason`` says why there are none."""
