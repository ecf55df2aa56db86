"""Sparse reconstruction of one window: start, grow, adjust, drop what does not fit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.reconstruction_kernels import triangulate
from laser_slam.backbones.classical.refinement import refine
from laser_slam.backbones.classical.tracking import FrameTracks
from laser_slam.backbones.classical.twoview import absolute_pose, choose_pair, relative_pose
from laser_slam.sim3 import Array

MIN_VIEWS = 3
MIN_POINTS = 40  # of a window; fewer say nothing
MIN_SEEN = 20  # points in one frame; fewer do not hold its camera
MIN_INLIERS = 30  # of the starting pair
MIN_ANGLE = 0.004  # radians between the rays of a point
PNP_ERROR_PX = 5.0  # at full width of 1280
COARSE_ROUNDS = ((2.0, 6.0), (2.0, 3.0))  # Huber and limit, in pixels at full width of 1280
FINE_ROUNDS = ((1.0, 3.0), (0.7, 1.5), (0.5, 1.5))
ITERATIONS = 15
MIN_RADIUS = 3  # pixels; a smaller patch is no pattern
BLUR_PX = 0.7  # of the images whose patches are aligned
LOCAL_ADJUSTMENTS = {1, 3, 6, 10, 14}  # frames after the start at which the window is adjusted


@dataclass
class Reconstruction:
    """Poses and points of a window.

    Attributes:
        rotations: (C, 3, 3) cam_from_window.
        translations: (C, 3).
        has_pose: (C,) cameras that could be placed.
        bundle: the points that fit, with their observations in the placed cameras.
        ids: (P,) track numbers of the points.
    """

    rotations: Array
    translations: Array
    has_pose: NDArray[np.bool_]
    bundle: Bundle
    ids: NDArray[np.int64]

    def depths_of(self, camera: int) -> Array:
        """Return the depths of the points that a camera sees, in front of it."""
        points = self.bundle.points[self.bundle.point_of[self.bundle.cameras == camera]]
        depths = points @ self.rotations[camera, 2] + self.translations[camera, 2]
        return np.asarray(depths[depths > 0])

    def poses_of(self, frames: list[int]) -> dict[int, tuple[Array, Array]]:
        """Return the cam_from_window rotations and translations of the frames that have one."""
        placed = np.flatnonzero(self.has_pose)
        return {frames[c]: (self.rotations[c], self.translations[c]) for c in placed}


@dataclass(frozen=True)
class Observations:
    """All tracks of a window that enough frames see, sorted by track and frame."""

    cameras: NDArray[np.int64]
    starts: NDArray[np.int64]
    pixels: Array
    ids: NDArray[np.int64]


def collect(views: list[FrameTracks]) -> Observations:
    """Gather the tracks that at least MIN_VIEWS of some frames see."""
    ids = np.concatenate([view.ids for view in views])
    cameras = np.repeat(np.arange(len(views)), [len(view.ids) for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    order = np.lexsort((cameras, ids))
    ids, cameras, pixels = ids[order], cameras[order], pixels[order]
    unique, counts = np.unique(ids, return_counts=True)
    enough = counts >= MIN_VIEWS
    keep = np.repeat(enough, counts)
    starts = np.concatenate([[0], np.cumsum(counts[enough])]).astype(np.int64)
    return Observations(cameras[keep], starts, pixels[keep], unique[enough])


def flat_intrinsics(K: Array) -> Array:
    """Return (8,) fx, fy, cx, cy and no distortion, as the kernels want them."""
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.zeros(4)])


class Solver:
    """Grow a reconstruction of one window from its tracks."""

    def __init__(self, views: list[FrameTracks], intrinsics: Array) -> None:
        self._views = views
        self._K = intrinsics
        self._unit = views[0].grey.shape[1] / 1280  # thresholds are in pixels at that width
        self._flat = flat_intrinsics(intrinsics)
        self._all = collect(views)
        num = len(views)
        self.rotations = np.tile(np.eye(3), (num, 1, 1))
        self.translations = np.zeros((num, 3))
        self.has_pose = np.zeros(num, bool)

    def start_from_pair(self) -> bool:
        """Place two views by their essential matrix; False: no pair moves enough."""
        pair = choose_pair(self._views, self._K)
        if pair is None:
            return False
        i, j = pair
        R, t, inliers = relative_pose(self._views[i], self._views[j], self._K, 2.0 * self._unit)
        if inliers < MIN_INLIERS:
            return False
        self.rotations[j], self.translations[j] = R, t
        self.has_pose[[i, j]] = True
        return True

    def start_from_known(self, known: Mapping[int, tuple[Array, Array]]) -> None:
        """Take the known cam_from_window rotations and translations of some of the views."""
        for view, (rotation, translation) in known.items():
            self.rotations[view], self.translations[view] = rotation, translation
            self.has_pose[view] = True

    def grow(self) -> None:
        """Place the other views outwards from those that are placed."""
        if not self.has_pose.any():
            return
        start, num = int(np.flatnonzero(self.has_pose)[0]), len(self._views)
        order = [c for c in (*range(start, num), *range(start - 1, -1, -1)) if not self.has_pose[c]]
        for done, camera in enumerate(order, start=1):
            self._place(camera)
            if done in LOCAL_ADJUSTMENTS:
                self.adjust(2.0 * self._unit, 8, 8.0)

    def _points(self) -> tuple[Array, NDArray[np.bool_]]:
        points, angles = triangulate(
            self.rotations,
            self.translations,
            self.has_pose,
            self._all.cameras,
            self._all.starts,
            self._all.pixels,
            self._flat,
        )
        return points, angles > MIN_ANGLE

    def _place(self, camera: int) -> None:
        """Find the pose of one view from the points that the placed ones see."""
        points, good = self._points()
        point_of = np.repeat(np.arange(len(points)), np.diff(self._all.starts))
        use = (self._all.cameras == camera) & good[point_of]
        if use.sum() < MIN_SEEN:
            return
        R, t, inliers = absolute_pose(
            self._all.pixels[use], points[point_of[use]], self._K, PNP_ERROR_PX * self._unit
        )
        if inliers >= MIN_SEEN:
            self.rotations[camera], self.translations[camera] = R, t
            self.has_pose[camera] = True

    def bundle(self, max_error_px: float) -> tuple[Bundle, NDArray[np.int64]]:
        """Triangulate everything and keep what fits; returns the bundle and its track numbers.

        The first placed view is held, and so are those that have no pose.
        """
        points, good = self._points()
        is_fixed = ~self.has_pose
        is_fixed[np.flatnonzero(self.has_pose)[:1]] = True
        bundle = Bundle(
            self.rotations,
            self.translations,
            points,
            self._all.cameras,
            self._all.starts,
            self._all.pixels,
            is_fixed,
            self._flat,
        )
        keep = bundle.residuals() < max_error_px * self._unit
        keep &= self.has_pose[self._all.cameras] & good[bundle.point_of]
        kept = bundle.select(keep, 2)
        return bundle, self._all.ids[kept]

    def adjust(self, huber_px: float, iterations: int, max_error_px: float) -> None:
        """Adjust the placed views on what fits, from fresh points."""
        if self.has_pose.sum() < 2:
            return
        bundle, _ = self.bundle(max_error_px)
        if len(bundle.points) >= MIN_SEEN:
            bundle.adjust(huber_px, iterations)

    def finish(self, refine_radius: int = 0) -> Reconstruction | None:
        """Adjust in rounds, each with less tolerance; measure the tracks again in between.

        Args:
            refine_radius: half side of the patches that are aligned at full resolution, in
                pixels at full width of 1280; 0: the tracks stay as they are.

        Returns:
            What is left; None: too little to be a reconstruction.
        """
        if self.has_pose.sum() < MIN_VIEWS:
            return None
        bundle, ids = self.bundle(8.0)
        ids = self._settle(bundle, ids, COARSE_ROUNDS)
        if refine_radius:
            radius = max(MIN_RADIUS, round(refine_radius * self._unit))
            greys = [view.grey.astype(np.float32) for view in self._views]
            blurred = np.stack([cv2.GaussianBlur(grey, (0, 0), BLUR_PX) for grey in greys])
            ids = ids[bundle.select(refine(bundle, blurred, radius), MIN_VIEWS)]
            ids = self._settle(bundle, ids, FINE_ROUNDS)
        ids = self._drop_loose_views(bundle, ids)
        is_finite = np.isfinite(self.translations).all() and np.isfinite(bundle.points).all()
        if len(bundle.points) < MIN_POINTS or not is_finite:
            return None
        return Reconstruction(self.rotations, self.translations, self.has_pose, bundle, ids)

    def _drop_loose_views(self, bundle: Bundle, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Take the pose from views that kept too few points to hold them."""
        while True:
            seen = np.bincount(bundle.cameras, minlength=len(self._views))
            is_loose = self.has_pose & (seen < MIN_SEEN)
            if not is_loose.any():
                return ids
            self.has_pose = self.has_pose & ~is_loose
            bundle.is_fixed = ~self.has_pose
            bundle.is_fixed[np.flatnonzero(self.has_pose)[:1]] = True
            ids = ids[bundle.select(~is_loose[bundle.cameras], MIN_VIEWS)]

    def mean_squared_error(self, bundle: Bundle, limit_px: float) -> float:
        """Return the mean over all observations, errors capped and lost ones at the limit."""
        limit = limit_px * self._unit
        kept = np.minimum(bundle.residuals(), limit) ** 2
        num = len(self._all.cameras)
        return float(kept.sum() + (num - len(kept)) * limit**2) / num

    def _settle(
        self, bundle: Bundle, ids: NDArray[np.int64], rounds: Iterable[tuple[float, float]]
    ) -> NDArray[np.int64]:
        """Adjust and drop what errs too much; (Huber, limit) in pixels each round."""
        for huber, limit in rounds:
            bundle.adjust(huber * self._unit, ITERATIONS)
            ids = ids[bundle.select(bundle.residuals() < limit * self._unit, MIN_VIEWS)]
        return ids
