"""How far a cloud is from laser scans."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

REACH_M = 50.0  # points further from every scanner are not compared: its lines are 35 cm apart
NEAREST_SCANS = 16  # those farther off hardly ever have a nearer laser point, and take time
BEYOND_M = 5.0  # distances are not told further than this
_AT_ONCE = 1 << 16  # points whose scans are looked up
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

    A point is compared with the ``NEAREST_SCANS`` that were taken nearest to it, of those within
    ``REACH_M`` that have it in their vertical field of view, and keeps the smallest distance. What
    lies outside all of them, such as roofs, says nothing.

    Attributes:
        distances: (N,) metres, infinite beyond ``BEYOND_M``; NaN: not compared.
    """

    def __init__(self, points: Array, world_from_scanner: Array) -> None:
        """Start.

        Args:
            points: (N, 3) of the cloud, in metres, in the world of the scans.
            world_from_scanner: (K, 4, 4) rigid, metres, of the scans to come, in their order.
        """
        self._points = points
        self._poses = world_from_scanner
        self._rows = _rows_by_scan(points, world_from_scanner[:, :3, 3])
        self.distances = np.full(len(points), np.nan)

    def add(self, index: int, scan: Array, workers: int = 1) -> None:
        """Compare with one more scan.

        Args:
            index: which of them.
            scan: (M, 3) points in the scanner's axes (z up).
            workers: threads.
        """
        rows = self._rows[index]
        world_from_scanner = self._poses[index]
        center, turn = world_from_scanner[:3, 3], world_from_scanner[:3, :3]
        seen = (self._points[rows] - center) @ turn
        far = np.linalg.norm(seen, axis=1).max(initial=0)
        scan = scan[np.linalg.norm(scan, axis=1) < far + BEYOND_M]
        if not len(rows) or not len(scan):
            return
        low, high = np.percentile(_elevation(scan), [RIM, 100 - RIM])
        elevation = _elevation(seen)
        is_inside = (elevation >= low) & (elevation <= high)
        rows = rows[is_inside]
        # Not balanced: that takes longer than all the rest.
        tree = cKDTree(scan, balanced_tree=False, compact_nodes=False)
        found, _ = tree.query(seen[is_inside], distance_upper_bound=BEYOND_M, workers=workers)
        self.distances[rows] = np.fmin(self.distances[rows], found)


def _rows_by_scan(points: Array, centers: Array) -> list[NDArray[np.intp]]:
    """Return for each scan the rows of the points that it is among the nearest to."""
    num = min(NEAREST_SCANS, len(centers))
    tree, nearest = cKDTree(centers), np.empty((len(points), num), np.int32)
    for start in range(0, len(points), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        _, nearest[rows] = tree.query(
            points[rows], k=[*range(1, num + 1)], distance_upper_bound=REACH_M
        )
    scans = nearest.ravel()
    order = np.argsort(scans, kind="stable")
    ends = np.searchsorted(scans[order], np.arange(len(centers) + 1))
    return [order[start:end] // num for start, end in pairwise(ends)]


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
