"""The default backbone: structure from motion and plane sweep, streaming over the windows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.calibration import calibrate
from laser_slam.backbones.classical.dense import depth_size
from laser_slam.backbones.classical.prediction import with_depth, without_depth
from laser_slam.backbones.classical.reconstruction import Reconstruction, Solver
from laser_slam.backbones.classical.tracking import FrameTracks, Tracker
from laser_slam.camera import guess_intrinsics
from laser_slam.config import BackboneConfig
from laser_slam.dependencies import num_threads
from laser_slam.sim3 import Array
from laser_slam.types import Calibration, Image, Prediction, Window

MIN_KNOWN = 3  # frames with poses that a window can go on from
ENOUGH_PLACED = 0.5  # share of a window's frames with which it may go on from the one before
MIN_PLACED = 0.25  # share that makes a window worth its depth

Poses = dict[int, tuple[Array, Array]]  # of some frames: cam_from_window


class ClassicalBackbone:
    """Classical geometry: no weights, no GPU; a known or calibrated camera and a static scene.

    It remembers the tracks and poses of the last frames: a window that continues the one before is
    solved together with that context, which keeps its scale. Any other window starts afresh.

    Attributes:
        remembers: True, see `laser_slam.backbones.base.Backbone`.
        sees_far_frames: False, for it follows corners from frame to frame.
    """

    remembers = True
    sees_far_frames = False

    def __init__(self, config: BackboneConfig) -> None:
        self._config = config.classical
        self._workers = ThreadPoolExecutor(num_threads())
        self._longest = 0  # frames of a window, for which there is memory
        self._tracker = Tracker(self._config, memory=0)
        self._poses: Poses = {}  # in the axes and the unit of the last window's solution

    def identity(self) -> dict[str, Any]:
        """Return its settings; see `laser_slam.backbones.base.Backbone`."""
        return self._config.model_dump(mode="json")

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) at which it wants images of (height, width) ``size``."""
        return depth_size(size, self._config.max_width)

    def calibrate(
        self, windows: Iterable[Window], intrinsics: NDArray[np.float64] | None
    ) -> Calibration:
        """Measure the camera by its own motion; see `laser_slam.backbones.base.Backbone`."""
        return calibrate(windows, intrinsics, self._config, self._workers)

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        """Predict one window; see `laser_slam.backbones.base.Backbone`."""
        K = guess_intrinsics(*images[0].shape[:2]) if intrinsics is None else intrinsics
        views = self._track(images, frames)
        window = views[-len(frames) :]
        solved = self._solve(views, window, K)
        if solved is not None:
            used, solution = solved
            prediction = with_depth(used, solution, frames, K, self._config, self._workers)
            if prediction.confidence.any():
                self._poses = solution.poses_of([view.frame for view in used])
                return prediction
        return without_depth(window, frames, K, self._config)

    def _track(self, images: Sequence[Image], frames: NDArray[np.int64]) -> list[FrameTracks]:
        """Track what is new; return the context and the window."""
        greys = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
        num_known = _num_continued(self._tracker.history, greys, frames)
        if num_known == 0 or len(frames) > self._longest:
            num_known, self._longest = 0, len(frames)
            self._tracker = Tracker(self._config, memory=self._config.context + len(frames))
            self._poses = {}
        for frame, grey in zip(frames[num_known:], greys[num_known:], strict=True):
            self._tracker.add(int(frame), grey)
        return self._tracker.history[-(self._config.context + len(frames)) :]

    def _solve(
        self, views: list[FrameTracks], window: list[FrameTracks], K: Array
    ) -> tuple[list[FrameTracks], Reconstruction] | None:
        """Go on from the known poses, which keeps the scale; if that fails at most frames, afresh.

        Returns:
            The frames that were used, context and window or some of the window, and what they gave.
        """
        known: Poses = {
            i: self._poses[v.frame] for i, v in enumerate(views) if v.frame in self._poses
        }
        radius = self._config.refine_radius
        placed, solution = _reconstruct(views, known, K, radius)
        is_placed = placed[-len(window) :]
        if solution is not None and is_placed.mean() >= ENOUGH_PLACED:
            return views, solution
        rest = [view for view, done in zip(window, is_placed, strict=True) if not done]
        num, used = int(is_placed.sum()), views
        if known or len(rest) < len(views):
            others, afresh = _reconstruct(rest, {}, K, radius)
            if others.sum() > num:
                num, used, solution = int(others.sum()), rest, afresh
        if solution is None or num < MIN_PLACED * len(window):
            return None
        return used, solution


def _num_continued(
    history: list[FrameTracks], greys: list[NDArray[np.uint8]], frames: NDArray[np.int64]
) -> int:
    """Return how many frames a window shares with the last ones seen; 0: it does not go on there.

    It goes on if it begins with exactly the last frames seen, unchanged, and has others after them.
    """
    shared = [view for view in history if view.frame >= frames[0]]
    num = len(shared)
    if num >= len(frames) or [view.frame for view in shared] != list(frames[:num]):
        return 0
    is_same = all(np.array_equal(v.grey, g) for v, g in zip(shared, greys, strict=False))
    return num if is_same else 0


def _reconstruct(
    views: list[FrameTracks], known: Poses, K: Array, radius: int
) -> tuple[NDArray[np.bool_], Reconstruction | None]:
    """Return which of the views could be placed, and the reconstruction if any could."""
    solver, solution = Solver(views, K), None
    if len(known) >= MIN_KNOWN:
        solver.start_from_known(known)
    if solver.has_pose.any() or solver.start_from_pair():
        solver.grow()
        solution = solver.finish(radius)
    return (np.zeros(len(views), bool) if solution is None else solution.has_pose), solution
