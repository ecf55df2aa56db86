"""Errors of point maps against true ones: accuracy, completeness, normals.

Reference: Spann3R (arXiv:2408.16061) and CUT3R (arXiv:2501.12387), whose evaluation the LASER
paper follows; the outdoor variant is VGGT-Long's (arXiv:2507.16443). Differs: a true point whose
pixel or whose whole frame has no prediction still counts for completeness, however unsure the rest
is; networks predict every pixel, so that their scores are the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from laser_slam.dependencies import import_open3d
from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation.depth import is_known
from laser_slam.sim3 import umeyama

Array = NDArray[np.float64]
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class PointProtocol:
    """What of the point maps is compared, and how they are brought together.

    Attributes:
        icp_threshold_m: farthest partner of a point in the iterative closest point refinement.
        crop_share: side of the central square that is compared, in widths of the map; None: all.
        dropped_share: share of the predicted points of all frames together, those of least
            confidence, that is left out with their true points, in [0, 1).
        has_normals: False leaves the normals out.
        max_depth_m: true depth beyond it is not compared: see ``comparable_depth``; None: all is.
        far_share: share of all pixels of a frame, the deepest, whose truth is not compared.
    """

    icp_threshold_m: float = 0.1
    crop_share: float | None = None
    dropped_share: float = 0.0
    has_normals: bool = True
    max_depth_m: float | None = None
    far_share: float = 0.0


# 7-Scenes and NRGBD: 224 pixels of maps that are 518 wide
INDOOR_POINTS = PointProtocol(crop_share=224 / 518, max_depth_m=10.0)
# Waymo
OUTDOOR_POINTS = PointProtocol(dropped_share=0.4, has_normals=False, far_share=0.02)


@dataclass(frozen=True)
class PointMap:
    """The points of one frame's pixels, predicted and true.

    Attributes:
        points: (H, W, 3) in world units; NaN: unknown.
        truth: (H, W, 3) in metres, in the truth's own frame; NaN: unknown.
        confidence: (H, W) in [0, 1]; None: there is none.

    Raises:
        ValueError: shapes disagree.
    """

    points: Array
    truth: Array
    confidence: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Check shapes once, here."""
        if self.points.shape != self.truth.shape or self.truth.shape[2:] != (3,):
            raise ValueError(f"points {self.points.shape}, truth {self.truth.shape}")
        if self.confidence is not None and self.confidence.shape != self.truth.shape[:2]:
            raise ValueError(f"confidence {self.confidence.shape}, truth {self.truth.shape}")


@dataclass(frozen=True)
class PointErrors:
    """How far predicted points are from the true surface and back; None: nothing to compare.

    Attributes:
        acc_mean_m: mean distance of a predicted point from the nearest true one.
        acc_median_m: their median.
        comp_mean_m: mean distance of a true point from the nearest predicted one.
        comp_median_m: their median.
        nc_mean: mean |cosine| between the normals of nearest points, averaged over both ways.
        nc_median: the medians, averaged over both ways.
        chamfer_m: mean of ``acc_mean_m`` and ``comp_mean_m``.
        scale: metres per world unit of the Sim(3) alignment.
        icp_fitness: share of the predicted points with a partner within the threshold at its end.
        num_points: predicted points that are compared.
        num_truth: true points that are compared.
        coverage: share of the true points whose pixel is predicted, before any is left out for its
            confidence; None: no truth.
        num_frames: frames with truth.
        num_predicted: frames of which any of these points is predicted.
        reason: why nothing is scored; None: it is.
    """

    acc_mean_m: float | None = None
    acc_median_m: float | None = None
    comp_mean_m: float | None = None
    comp_median_m: float | None = None
    nc_mean: float | None = None
    nc_median: float | None = None
    chamfer_m: float | None = None
    scale: float | None = None
    icp_fitness: float | None = None
    num_points: int = 0
    num_truth: int = 0
    coverage: float | None = None
    num_frames: int = 0
    num_predicted: int = 0
    reason: str | None = None


def comparable_depth(depth: Depth, protocol: PointProtocol) -> Depth:
    """Return a frame's true depth without what the protocol takes for too far to be right.

    Args:
        depth: (H, W) true depth in metres, as the data set has it, before it is resized; not
            finite or not positive: unknown, which counts as depth 0 for ``far_share``. So where
            a laser sees a twentieth of the pixels, a share of 0.02 are two fifths of its points,
            and where it sees no more than that share, nothing is too far.
        protocol: what is compared.

    Returns:
        (H, W); NaN: unknown or not compared.
    """
    known = is_known(depth)
    if protocol.max_depth_m is not None:
        known &= depth <= protocol.max_depth_m
    if protocol.far_share and depth.size:
        limit = np.percentile(np.where(known, depth, 0), 100 * (1 - protocol.far_share))
        known &= (depth <= limit) | (limit == 0)
    return np.where(known, depth, np.nan).astype(np.float32)


def evaluate_points(maps: Iterable[PointMap], protocol: PointProtocol) -> PointErrors:
    """Compare point maps with the truth after Sim(3) alignment and ICP.

    Pixels correspond for the alignment (Umeyama), nearest points for the rest. Frames are read one
    at a time; only what is compared is kept: 57 bytes a pixel.

    Args:
        maps: one for each frame with truth, all in one frame of coordinates; all NaN where nothing
            is predicted, so that its truth counts.
        protocol: what is compared.

    Raises:
        ValueError: the protocol drops by confidence, and a map has none.
    """
    parts = [part for part in (_known_truth(each, protocol) for each in maps) if len(part.true)]
    pixels = _join(parts)
    counted = PointErrors(
        coverage=float(pixels.is_predicted.mean()) if parts else None,
        num_frames=len(parts),
        num_predicted=sum(bool(part.is_predicted.any()) for part in parts),
    )
    pixels = _surest(pixels, protocol.dropped_share)
    found, true = pixels.found[pixels.is_predicted], pixels.true[pixels.is_predicted]
    counted = replace(counted, num_points=len(found), num_truth=len(pixels.true))
    try:
        metric_from_world = umeyama(found, true)
    except DegenerateGeometryError as error:
        return replace(counted, reason=str(error))
    cloud, target = _cloud(metric_from_world.apply(found)), _cloud(pixels.true)
    fitness = _refine(cloud, target, protocol.icp_threshold_m)
    counted = replace(counted, scale=metric_from_world.scale, icp_fitness=fitness)
    return _scores(cloud, target, protocol, counted)


@dataclass(frozen=True)
class _Pixels:
    """Pixels that have truth.

    Attributes:
        found: (M, 3) predicted points, NaN where unknown.
        true: (M, 3).
        is_predicted: (M,).
        confidence: (M,); -1: unknown.
    """

    found: Array
    true: Array
    is_predicted: NDArray[np.bool_]
    confidence: Array


def _known_truth(each: PointMap, protocol: PointProtocol) -> _Pixels:
    if protocol.dropped_share and each.confidence is None:
        raise ValueError("the least confident points are to be dropped, and there is no confidence")
    rows, columns = _central_square(each.truth.shape, protocol.crop_share)
    found, true = each.points[rows, columns], each.truth[rows, columns]
    valid = np.isfinite(true).all(axis=-1)
    found, true = found[valid], true[valid]
    confidence = np.full(len(true), -1.0)
    if each.confidence is not None:
        given = each.confidence[rows, columns][valid]
        confidence = np.where(np.isnan(given), -1.0, given)
    return _Pixels(found, true, np.asarray(np.isfinite(found).all(axis=-1)), confidence)


def _join(parts: Sequence[_Pixels]) -> _Pixels:
    """Put the pixels of all frames together."""
    return _Pixels(
        np.concatenate([np.empty((0, 3)), *(part.found for part in parts)]),
        np.concatenate([np.empty((0, 3)), *(part.true for part in parts)]),
        np.concatenate([np.empty(0, np.bool_), *(part.is_predicted for part in parts)]),
        np.concatenate([np.empty(0), *(part.confidence for part in parts)]),
    )


def _surest(pixels: _Pixels, dropped_share: float) -> _Pixels:
    """Leave out the least confident share of the predicted points, and their true points."""
    if not dropped_share or not pixels.is_predicted.any():
        return pixels
    cutoff = np.percentile(pixels.confidence[pixels.is_predicted], 100 * dropped_share)
    kept = (pixels.confidence >= cutoff) | ~pixels.is_predicted
    return _Pixels(
        pixels.found[kept],
        pixels.true[kept],
        pixels.is_predicted[kept],
        pixels.confidence[kept],
    )


def _central_square(shape: tuple[int, ...], share: float | None) -> tuple[slice, slice]:
    if share is None:
        return slice(None), slice(None)
    side = round(share * shape[1])
    first = [max(size // 2 - side // 2, 0) for size in shape[:2]]
    return slice(first[0], first[0] + side), slice(first[1], first[1] + side)


def _cloud(points: Array) -> Any:
    open3d = import_open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.ascontiguousarray(points)))


def _refine(cloud: Any, target: Any, threshold: float) -> float:
    """Move ``cloud`` by point-to-point ICP from where it is; return the share of partners."""
    registration = import_open3d().pipelines.registration
    estimation = registration.TransformationEstimationPointToPoint()
    result = registration.registration_icp(cloud, target, threshold, np.eye(4), estimation)
    cloud.transform(result.transformation)
    return float(result.fitness)


def _scores(cloud: Any, target: Any, protocol: PointProtocol, counted: PointErrors) -> PointErrors:
    points, truth = np.asarray(cloud.points), np.asarray(target.points)
    acc, nearest_true = cKDTree(truth).query(points, workers=-1)
    comp, nearest_point = cKDTree(points).query(truth, workers=-1)
    nc_mean = nc_median = None
    if protocol.has_normals:
        normals, true_normals = _normals(cloud), _normals(target)
        there = np.abs((true_normals[nearest_true] * normals).sum(axis=1))
        back = np.abs((true_normals * normals[nearest_point]).sum(axis=1))
        nc_mean = float(there.mean() + back.mean()) / 2
        nc_median = float(np.median(there) + np.median(back)) / 2
    return replace(
        counted,
        acc_mean_m=float(acc.mean()),
        acc_median_m=float(np.median(acc)),
        comp_mean_m=float(comp.mean()),
        comp_median_m=float(np.median(comp)),
        nc_mean=nc_mean,
        nc_median=nc_median,
        chamfer_m=float(acc.mean() + comp.mean()) / 2,
    )


def _normals(cloud: Any) -> Array:
    """Return (N, 3) unit normals from each point's 30 neighbours, Open3D's default."""
    cloud.estimate_normals()
    return np.asarray(cloud.normals)
