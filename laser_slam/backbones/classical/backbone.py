"""The default backbone: structure from motion and plane sweep, streaming over the windows."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.calibration import calibrate
from laser_slam.backbones.classical.dense import PosedFrames, dense_depth, depth_size
from laser_slam.backbones.classical.reconstruction import Reconstruction, Solver
from laser_slam.backbones.classical.tracking import FrameTracks, Tracker
from laser_slam.backbones.classical.twoview import measure_motion
from laser_slam.camera import guess_intrinsics, resize_intrinsics
from laser_slam.config import BackboneConfig
from laser_slam.sim3 import Array, interpolate_poses
from laser_slam.types import Calibration, Image, Prediction, Window, WindowStatus

STILL_PX, MOVED_PX = 1.0, 1.5  # parallax and flow at 640 wide
MAX_WINDOW = 128


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
        height, width = images[0].shape[:2]
        K = guess_intrinsics(height, width) if intrinsics is None else intrinsics
        views = self._track(images, frames)
        solution, warnings = self._solve(views, frames, K)
        if solution is None:
            return self._without_depth(views, frames, K)
        return self._dense(views, frames, K, solution, warnings)

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

    def _solve(
        self, views: list[FrameTracks], frames: NDArray[np.int64], K: Array
    ) -> tuple[Reconstruction | None, tuple[str, ...]]:
        """Reconstruct context and window; without the context where that fails."""
        is_window = np.array([view.frame >= frames[0] for view in views])
        for is_used in (np.ones(len(views), bool), is_window):
            used = [view for view, keep in zip(views, is_used, strict=True) if keep]
            solver = Solver(used, K)
            if not self._start(solver, used):
                continue
            solver.grow()
            solution = solver.finish(self._config.refine_radius)
            if solution is not None and solution.has_pose[-len(frames) :].mean() > 0.5:
                self._remember(used, solution)
                return solution, ()
        self._poses = {}
        return None, ()

    def _start(self, solver: Solver, views: list[FrameTracks]) -> bool:
        known = [view.frame in self._poses for view in views]
        if sum(known) < 3:
            return solver.start_from_pair()
        R = np.stack(
            [self._poses[v.frame][0] if v.frame in self._poses else np.eye(3) for v in views]
        )
        t = np.stack(
            [self._poses[v.frame][1] if v.frame in self._poses else np.zeros(3) for v in views]
        )
        solver.start_from_known(R, t, np.array(known))
        return True

    def _remember(self, views: list[FrameTracks], solution: Reconstruction) -> None:
        self._poses = {
            view.frame: (solution.rotations[i], solution.translations[i])
            for i, view in enumerate(views)
            if solution.has_pose[i]
        }

    def _dense(self, views, frames, K, solution, warnings) -> Prediction:  # type: ignore[no-untyped-def]
        """Sweep the window's frames and express everything in units of the median depth."""
        num = len(solution.rotations)
        used = views[-num:]
        bundle = solution.bundle
        points = bundle.points[bundle.point_of]
        z = np.einsum("mj,mj->m", bundle.rotations[bundle.cameras][:, 2], points)
        z += bundle.translations[bundle.cameras][:, 2]
        posed = np.flatnonzero(solution.has_pose)
        sparse = [z[(bundle.cameras == c) & (z > 0)] for c in posed]
        scene = PosedFrames(
            [used[c].grey for c in posed],
            solution.rotations[posed],
            solution.translations[posed],
            sparse,
            K,
        )
        window = [i for i, c in enumerate(posed) if used[c].frame >= frames[0]]
        depth, confidence, depth_K = dense_depth(scene, window, self._config, self._workers)
        unit = float(np.median(np.concatenate([sparse[i] for i in window])))
        slots = np.searchsorted(frames, [used[posed[i]].frame for i in window])
        all_depth = np.full((len(frames), *depth.shape[1:]), np.nan, np.float32)
        all_confidence = np.zeros(all_depth.shape, np.float32)
        all_depth[slots], all_confidence[slots] = depth / unit, confidence
        window_from_cam = np.tile(np.eye(4), (len(window), 1, 1))
        R = solution.rotations[posed[window]]
        window_from_cam[:, :3, :3] = R.transpose(0, 2, 1)
        window_from_cam[:, :3, 3] = (
            -np.einsum("cij,ci->cj", R, solution.translations[posed[window]]) / unit
        )
        first_from_window = np.linalg.inv(window_from_cam[0])
        poses = interpolate_poses(
            frames.astype(np.float64),
            frames[slots].astype(np.float64),
            first_from_window @ window_from_cam,
        )
        if len(slots) < len(frames):
            warnings = (*warnings, f"{len(frames) - len(slots)} frames could not be placed")
        return Prediction(
            frames,
            all_depth,
            all_confidence,
            poses,
            np.tile(depth_K, (len(frames), 1, 1)),
            WindowStatus.OK,
            tuple(warnings),
        )

    def _without_depth(
        self, views: list[FrameTracks], frames: NDArray[np.int64], K: Array
    ) -> Prediction:
        """Say what can be said of a window without a solution: rotations, if they explain it."""
        window = views[-len(frames) :]
        height, width = window[0].grey.shape
        pixel = width / 640
        motions = [measure_motion(a, b, K) for a, b in pairwise(window)]
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        status = WindowStatus.FAILED
        if all(motion.num_matches >= 30 for motion in motions):
            is_still = max(motion.flow_px for motion in motions) < MOVED_PX * pixel
            status = WindowStatus.STATIC if is_still else WindowStatus.ROTATION
            for i, motion in enumerate(motions):
                poses[i + 1, :3, :3] = poses[i, :3, :3] @ motion.second_from_first.T
        size = depth_size((height, width), self._config.depth_width)
        depth = np.full((len(frames), *size), np.nan, np.float32)
        depth_K = resize_intrinsics(K, (height, width), size)
        return Prediction(
            frames,
            depth,
            np.zeros_like(depth),
            poses,
            np.tile(depth_K, (len(frames), 1, 1)),
            status,
        )
