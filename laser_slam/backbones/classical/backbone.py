"""The default backbone: structure from motion and plane sweep, streaming over the windows."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

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
from laser_slam.sim3 import Array
from laser_slam.types import Calibration, Image, Prediction, Window

MAX_WINDOW = 128  # keyframes
MIN_KNOWN = 3  # frames with poses that a window can go on from
MIN_PLACED = 0.25  # share of a window's frames that make it worth its depth


class ClassicalBackbone:
    """Classical geometry: no weights, no GPU; a known or calibrated camera and a static scene.

    It remembers the tracks and poses of the last frames: a window that continues the one before is
    solved together with that context, which keeps its scale. Any other window starts afresh.
    """

    def __init__(self, config: BackboneConfig) -> None:
        self._config = config.classical
        self._workers = ThreadPoolExecutor(os.cpu_count() or 1)
        self._tracker = self._new_tracker()
        self._poses: dict[
            int, tuple[Array, Array]
        ] = {}  # frame: cam_from_window, last window's axes

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
        for used in (views, window):  # where the context does not carry on, without it
            solution = self._reconstruct(used, K)
            if solution is None or solution.has_pose[-len(frames) :].mean() < MIN_PLACED:
                continue
            self._poses = solution.poses_of([view.frame for view in used])
            return with_depth(used, solution, frames, K, self._config, self._workers)
        self._poses = {}
        return without_depth(window, frames, K, self._config)

    def _new_tracker(self) -> Tracker:
        return Tracker(self._config, self._config.context + MAX_WINDOW)

    def _track(self, images: Sequence[Image], frames: NDArray[np.int64]) -> list[FrameTracks]:
        """Track what is new; return the context and the window."""
        known = {view.frame for view in self._tracker.history}
        if int(frames[0]) not in known:
            self._tracker, self._poses, known = self._new_tracker(), {}, set()
        for frame, image in zip(frames, images, strict=True):
            if int(frame) not in known:
                self._tracker.add(int(frame), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        history = [view for view in self._tracker.history if view.frame <= frames[-1]]
        first = next(i for i, view in enumerate(history) if view.frame == frames[0])
        return history[max(0, first - self._config.context) :]

    def _reconstruct(self, views: list[FrameTracks], K: Array) -> Reconstruction | None:
        solver = Solver(views, K)
        known = {i: self._poses[v.frame] for i, v in enumerate(views) if v.frame in self._poses}
        if len(known) >= MIN_KNOWN:
            solver.start_from_known(known)
        elif not solver.start_from_pair():
            return None
        solver.grow()
        return solver.finish(self._config.refine_radius)
