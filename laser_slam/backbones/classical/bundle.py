"""Bundle adjustment of one window: Levenberg-Marquardt on poses, points eliminated (Schur)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.bundle_kernels import levenberg_marquardt, residual_norms

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass
class Bundle:
    """A window's unknowns and measurements; poses and points are updated in place.

    Attributes:
        rotations: (C, 3, 3) cam_from_window.
        translations: (C, 3) cam_from_window.
        points: (P, 3) in window axes and units.
        cameras: (M,) camera of each observation.
        starts: (P + 1,) first observation of each point; observations are sorted by point.
        pixels: (M, 2) measured positions.
        is_fixed: (C,) cameras that stay where they are.
        intrinsics: (8,) fx, fy, cx, cy, and the distortion k1, k2, p1, p2 of OpenCV.
    """

    rotations: Array
    translations: Array
    points: Array
    cameras: Index
    starts: Index
    pixels: Array
    is_fixed: NDArray[np.bool_]
    intrinsics: Array

    @property
    def point_of(self) -> Index:
        """Return the (M,) point of each observation."""
        return np.repeat(np.arange(len(self.points)), np.diff(self.starts))

    def residuals(self) -> Array:
        """Return (M,) reprojection errors in pixels; infinite behind the camera."""
        out = np.empty(len(self.cameras))
        residual_norms(
            self.rotations,
            self.translations,
            self.points,
            self.cameras,
            self.starts,
            self.pixels,
            self.intrinsics,
            out,
        )
        return out

    def adjust(self, huber_px: float, iterations: int) -> float:
        """Minimise the Huber cost of the reprojection errors.

        Args:
            huber_px: where the loss turns from square to linear.
            iterations: upper limit; it stops early when the cost settles.

        Returns:
            The final cost per observation, in squared pixels.
        """
        cost = levenberg_marquardt(
            self.rotations,
            self.translations,
            self.points,
            self.cameras,
            self.starts,
            self.pixels,
            self.is_fixed,
            self.intrinsics,
            huber_px,
            iterations,
        )
        return float(cost) / max(1, len(self.cameras))

    def select(self, keep: NDArray[np.bool_], min_views: int) -> NDArray[np.bool_]:
        """Drop observations, then points that are left with too few; return (P,) kept points."""
        point_of = self.point_of
        views = np.bincount(point_of[keep], minlength=len(self.points))
        is_kept = views >= min_views
        keep = keep & is_kept[point_of]
        self.cameras, self.pixels = self.cameras[keep], self.pixels[keep]
        self.starts = np.concatenate([[0], np.cumsum(views[is_kept])]).astype(np.int64)
        self.points = self.points[is_kept]
        return np.asarray(is_kept)
