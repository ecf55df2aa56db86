"""Depth of a run's keyframes against that of their laser scans."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.velodyne import Velodyne
from laser_slam.evaluation import evaluate_depth
from laser_slam.export import DepthView
from laser_slam.rectification import Rectifier
from laser_slam.types import Calibration

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

MOST_PIXELS = 2_000_000  # of all keyframes together, evenly taken
RANGES_M = (0, 10, 20, 40, 120)


@dataclass
class ScannedPixels:
    """The pixels of keyframes that have a laser point.

    Attributes:
        velodyne: the scans.
        calibration: of the run's camera, which its depth maps are free of.
        min_confidence: below which depth is not compared.
    """

    velodyne: Velodyne
    calibration: Calibration
    min_confidence: float
    _parts: list[tuple[int, Depth, Depth, NDArray[np.bool_]]] = field(default_factory=list)

    def add(self, view: DepthView, num_views: int) -> None:
        """Take what laser points hit; all keyframes together give ``MOST_PIXELS`` at most.

        Raises:
            DatasetError: the scan is broken.
        """
        truth = self.velodyne.depth(view.frame)
        assert truth is not None  # only frames with scans were asked for
        size = (view.depth.shape[0], view.depth.shape[1])
        truth = Rectifier(self.calibration, size).depth(truth)
        rows = np.flatnonzero(np.isfinite(truth))
        rows = rows[:: max(1, -(-len(rows) * num_views // MOST_PIXELS))]
        depth = view.depth.ravel()[rows]
        is_sure = (view.confidence.ravel()[rows] >= self.min_confidence) & (depth > 0)
        self._parts.append((view.frame, depth, truth.ravel()[rows], is_sure))

    def ratios(self) -> Array:
        """Return for each keyframe with sure depth the median of laser depth over its own."""
        found = [_ratio(depth, truth, sure) for _, depth, truth, sure in self._parts if sure.any()]
        return np.array(found)

    def scores(
        self, metres_per_unit: float, metres_at: Callable[[int], float]
    ) -> dict[str, Any] | None:
        """Score the sure depth by several scales; None: no keyframe has a scan.

        Args:
            metres_per_unit: by the whole path.
            metres_at: by the piece of the path that a frame belongs to.
        """
        if not self._parts:
            return None
        by_path = self._scored([metres_per_unit for _ in self._parts])
        by_piece = [metres_at(frame) for frame, *_ in self._parts]
        own = [_ratio(depth, truth, sure) for _, depth, truth, sure in self._parts]
        misfits, ranges_m = self._misfits(by_piece)
        return {
            "num_keyframes": len(self._parts),
            "min_confidence": self.min_confidence,
            "median_rel": float(np.median(np.abs(misfits))) if len(misfits) else None,
            "by_range": list(_by_range(misfits, ranges_m)),
            "by_trajectory_scale": by_path | {"scale": metres_per_unit},
            "by_piece_scale": self._scored(by_piece),
            "by_median_ratio": self._scored(None),
            "by_keyframe_ratio": self._scored(own),
        }

    def _scored(self, scales: list[float] | None) -> dict[str, Any]:
        """Score with a scale for each keyframe, or with one for all that suits the median."""
        _, depths, truths, masks = (list(part) for part in zip(*self._parts, strict=True))
        if scales is None:
            return asdict(evaluate_depth(depths, truths, masks))
        scaled = [depth * np.float32(scale) for depth, scale in zip(depths, scales, strict=True)]
        errors = evaluate_depth(scaled, truths, masks, "none")
        return asdict(replace(errors, scale=None))

    def _misfits(self, scales: list[float]) -> tuple[Array, Array]:
        """Return the relative errors of all sure pixels, and how far these are in metres."""
        misfits: list[Array] = [np.empty(0)]
        ranges_m: list[Array] = [np.empty(0)]
        for (_, depth, truth, sure), scale in zip(self._parts, scales, strict=True):
            true = truth[sure].astype(np.float64)
            misfits.append(scale * depth[sure] / true - 1)
            ranges_m.append(true)
        return np.concatenate(misfits), np.concatenate(ranges_m)


def _ratio(depth: Depth, truth: Depth, sure: NDArray[np.bool_]) -> float:
    return float(np.median(truth[sure] / depth[sure])) if sure.any() else 1.0


def _by_range(misfits: Array, ranges_m: Array) -> Iterator[dict[str, float | int]]:
    """Give the errors between one distance and the next, where there are pixels."""
    for near_m, far_m in pairwise(RANGES_M):
        chosen = misfits[(ranges_m >= near_m) & (ranges_m < far_m)]
        if not len(chosen):
            continue
        yield {
            "from_m": near_m,
            "to_m": far_m,
            "abs_rel": float(np.mean(np.abs(chosen))),
            "median_rel": float(np.median(np.abs(chosen))),
            "delta_125": float(np.mean((chosen < 0.25) & (chosen > -0.2))),
            "num_pixels": len(chosen),
        }
