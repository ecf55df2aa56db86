"""Sparse reconstruction of one window: start, grow, adjust, drop what does not fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.refinement import refine
from laser_slam.backbones.classical.tracking import FrameTracks
from laser_slam.backbones.classical.twoview import absolute_pose, choose_pair, relative_pose
from laser_slam.sim3 import Array

MIN_VIEWS = 3
MIN_POINTS = 40  # fewer do not hold a camera
MIN_ANGLE = 0.004  # radians between the rays of a point
PNP_ERROR_PX = 5.0  # at full width of 1280
COARSE_ROUNDS = ((2.0, 6.0), (2.0, 3.0))  # Huber and limit, in pixels at full width of 1280
FINE_ROUNDS = ((1.0, 3.0), (0.7, 1.5), (0.5, 1.5))
ITERATIONS = 15
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


@dataclass(frozen=True)
class Observations:
    """All tracks of a window that enough frames see, sorted by track and frame."""

    cameras: NDArray[np.int64]
    starts: NDArray[np.int64]
    pixels: Array
    ids: NDArray[np.int64]


def collect(views: list[FrameTracks], min_views: int = MIN_VIEWS) -> Observations:
    """Gather the tracks of some frames."""
    ids = np.concatenate([view.ids for view in views])
    cameras = np.repeat(np.arange(len(views)), [len(view.ids) for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    order = np.lexsort((cameras, ids))
    ids, cameras, pixels = ids[order], cameras[order], pixels[order]
    unique, counts = np.unique(ids, return_counts=True)
    keep = np.repeat(counts >= min_views, counts)
    starts = np.concatenate([[0], np.cumsum(counts[counts >= min_views])]).astype(np.int64)
    return Observations(cameras[keep], starts, pixels[keep], unique[counts >= min_views])


@njit(cache=True, nogil=True)
def triangulate(rotations, translations, has_pose, cameras, starts, pixels, intrinsics):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """Return (P, 3) points nearest to their rays, and (P,) widest angle between two rays (0: none)."""
    num = starts.shape[0] - 1
    points, angles = np.zeros((num, 3)), np.zeros(num)
    for point in range(num):
        A, b = np.zeros((3, 3)), np.zeros(3)
        first, views, cosine = np.zeros(3), 0, 1.0
        for o in range(starts[point], starts[point + 1]):
            c = cameras[o]
            if not has_pose[c]:
                continue
            ray = np.array(
                [
                    (pixels[o, 0] - intrinsics[2]) / intrinsics[0],
                    (pixels[o, 1] - intrinsics[3]) / intrinsics[1],
                    1.0,
                ]
            )
            ray = rotations[c].T @ (ray / np.sqrt((ray * ray).sum()))
            centre = -(rotations[c].T @ translations[c])
            across = np.eye(3) - np.outer(ray, ray)
            A += across
            b += across @ centre
            if views == 0:
                first = ray
            cosine = min(cosine, (first * ray).sum())
            views += 1
        angle = np.arccos(max(-1.0, cosine))
        if views >= 2 and angle > 1e-5:
            points[point] = np.linalg.solve(A, b)
            angles[point] = angle
    return points, angles


class Solver:
    """Grow a reconstruction of one window from its tracks."""

    def __init__(self, views: list[FrameTracks], intrinsics: Array) -> None:
        self._views = views
        self._K = intrinsics
        self._unit = views[0].grey.shape[1] / 1280  # thresholds are in pixels at that width
        self._flat = np.array(
            [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2], 0.0, 0.0]
        )
        self._all = collect(views)
        num = len(views)
        self.rotations = np.tile(np.eye(3), (num, 1, 1))
        self.translations = np.zeros((num, 3))
        self.has_pose = np.zeros(num, bool)
        self.is_fixed = np.zeros(num, bool)

    def start_from_pair(self) -> bool:
        """Place two views by their essential matrix; False: no pair moves enough."""
        pair = choose_pair(self._views, self._K)
        if pair is None:
            return False
        i, j = pair
        R, t, _ = relative_pose(self._views[i], self._views[j], self._K, 2.0 * self._unit)
        self.rotations[j], self.translations[j] = R, t
        self.has_pose[[i, j]] = True
        return True

    def start_from_known(
        self, rotations: Array, translations: Array, is_known: NDArray[np.bool_]
    ) -> None:
        """Take the known cam_from_window poses of earlier frames."""
        self.rotations[is_known] = rotations[is_known]
        self.translations[is_known] = translations[is_known]
        self.has_pose |= is_known

    def grow(self) -> None:
        """Place the other views outwards from those that are placed."""
        placed = np.flatnonzero(self.has_pose)
        order = [*range(placed[0] + 1, len(self._views)), *range(placed[0] - 1, -1, -1)]
        done = 0
        for camera in order:
            if self.has_pose[camera]:
                continue
            points, good = self._points()
            self._place(camera, points, good)
            done += 1
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

    def _place(self, camera: int, points: Array, good: NDArray[np.bool_]) -> None:
        point_of = np.repeat(np.arange(len(points)), np.diff(self._all.starts))
        use = (self._all.cameras == camera) & good[point_of]
        if use.sum() < MIN_POINTS // 2:
            return
        R, t, inliers = absolute_pose(
            self._all.pixels[use], points[point_of[use]], self._K, PNP_ERROR_PX * self._unit
        )
        if inliers >= MIN_POINTS // 2:
            self.rotations[camera], self.translations[camera] = R, t
            self.has_pose[camera] = True

    def bundle(self, max_error_px: float) -> tuple[Bundle, NDArray[np.int64]]:
        """Triangulate everything and keep what fits; returns the bundle and its track numbers."""
        points, good = self._points()
        bundle = Bundle(
            self.rotations,
            self.translations,
            points,
            self._all.cameras,
            self._all.starts,
            self._all.pixels,
            self.is_fixed | ~self.has_pose,
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
        if len(bundle.points) < MIN_POINTS // 2:
            return
        self._anchor(bundle)
        bundle.adjust(huber_px, iterations)

    def _anchor(self, bundle: Bundle) -> None:
        """Hold the first placed view when nothing else does."""
        if not self.is_fixed.any():
            bundle.is_fixed = bundle.is_fixed.copy()
            bundle.is_fixed[np.flatnonzero(self.has_pose)[0]] = True

    def finish(self, refine_radius: int = 0) -> Reconstruction | None:
        """Adjust in rounds, each with less tolerance; measure the tracks again in between.

        Args:
            refine_radius: half side in pixels of the patches that are aligned at full
                resolution; 0: the tracks stay as they are.

        Returns:
            What is left; None: too little to be a reconstruction.
        """
        if self.has_pose.sum() < MIN_VIEWS:
            return None
        bundle, ids = self.bundle(8.0)
        self._anchor(bundle)
        ids = self._settle(bundle, ids, COARSE_ROUNDS)
        if refine_radius:
            greys = [view.grey.astype(np.float32) for view in self._views]
            blurred = np.stack([cv2.GaussianBlur(grey, (0, 0), BLUR_PX) for grey in greys])
            ids = ids[bundle.select(refine(bundle, blurred, refine_radius), MIN_VIEWS)]
            ids = self._settle(bundle, ids, FINE_ROUNDS)
        if len(bundle.points) < MIN_POINTS:
            return None
        return Reconstruction(self.rotations, self.translations, self.has_pose, bundle, ids)

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
