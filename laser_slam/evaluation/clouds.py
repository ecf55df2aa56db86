"""How far a cloud is from laser scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

REACH_M = 50.0  # points further from every scanner are not compared: its lines are 35 cm apart
BEYOND_M = 5.0  # distances are not told further than this
RIM = 0.5  # percent of a scan's points above and below its field: strays


@dataclass(frozen=True)
class CloudErrors:
    """Distances of a cloud's points from the nearest laser points; None: nothing to compare.

    Attributes:
        median_m: middle distance; infinite beyond ``BEYOND_M``.
        within_10_cm: share of the compared points.
        within_20_cm: likewise.
        within_50_cm: likewise.
        num_points: compared points.
        coverage: their share of the cloud: what a scan's field of view and reach cover.
    """

    median_m: float | None
    within_10_cm: float | None
    within_20_cm: float | None
    within_50_cm: float | None
    num_points: int
    coverage: float | None


class ScanDistances:
    """Distances of a cloud from scans that come one after another; only one is held at a time.

    A point is compared with every scan within ``REACH_M`` that has it in its vertical field of
    view, and keeps the smallest distance. What lies outside all of them, such as roofs, says
    nothing.

    Attributes:
        distances: (N,) metres, infinite beyond ``BEYOND_M``; NaN: not compared.
    """

    def __init__(self, points: Array) -> None:
        """Start.

        Args:
            points: (N, 3) of the cloud, in metres, in the world of the scans.
        """
        self._points = points
        self.distances = np.full(len(points), np.nan)

    def add(self, world_from_scanner: Array, scan: Array, workers: int = 1) -> None:
        """Compare with one more scan.

        Args:
            world_from_scanner: (4, 4) rigid, metres.
            scan: (M, 3) points in the scanner's axes (z up).
            workers: threads.
        """
        scan = scan[np.linalg.norm(scan, axis=1) < REACH_M + BEYOND_M]
        if not len(scan):
            return
        center, turn = world_from_scanner[:3, 3], world_from_scanner[:3, :3]
        near = np.flatnonzero(((self._points - center) ** 2).sum(axis=1) < REACH_M**2)
        seen = (self._points[near] - center) @ turn
        low, high = np.percentile(_elevation(scan), [RIM, 100 - RIM])
        elevation = _elevation(seen)
        is_inside = (elevation >= low) & (elevation <= high)
        rows = near[is_inside]
        # As found: balancing the tree takes twice the time of all the rest.
        tree = cKDTree(scan, balanced_tree=False, compact_nodes=False)
        found, _ = tree.query(seen[is_inside], distance_upper_bound=BEYOND_M, workers=workers)
        self.distances[rows] = np.fmin(self.distances[rows], found)


def cloud_errors(distances: Array) -> CloudErrors:
    """Sum up (N,) distances of a cloud's points; NaN: not compared."""
    compared = distances[~np.isnan(distances)]
    coverage = len(compared) / len(distances) if len(distances) else None
    if not len(compared):
        return CloudErrors(None, None, None, None, 0, coverage)
    cm_10, cm_20, cm_50 = (float(np.mean(compared <= limit)) for limit in (0.1, 0.2, 0.5))
    median = float(np.median(compared))
    return CloudErrors(median, cm_10, cm_20, cm_50, len(compared), coverage)


def _elevation(points: Array) -> Array:
    return np.asarray(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
