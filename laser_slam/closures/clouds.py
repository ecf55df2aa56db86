"""The clouds of two ends laid on one another: how far they agree, and how to make them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from laser_slam.camera import unproject
from laser_slam.closures.ends import End, frames_around
from laser_slam.config import ClosuresConfig
from laser_slam.dependencies import import_open3d
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array, Sim3

_MIN_POINTS = 100
_MAX_PIXELS = 20_000  # of a frame
_EDGE = 0.1  # step between neighbours, in their depth, that makes a depth edge
_NORMAL_REACH = 3.0  # voxels


@dataclass(frozen=True)
class EndCloud:
    """The surfaces around one end, in the axes and units of its window.

    Attributes:
        points: (P, 3) one a voxel.
        normals: (P, 3) of unit length, of either sign.
        depths: (K, H, W) of the frames they come from; NaN where a pixel gave no point.
        intrinsics: (K, 3, 3).
        cam_from_window: K rigid motions.
        unit: the end's median depth.
    """

    points: Array
    normals: Array
    depths: NDArray[np.float32]
    intrinsics: Array
    cam_from_window: list[Sim3]
    unit: float

    @cached_property
    def tree(self) -> cKDTree:
        """Return the points, ready for searches."""
        return cKDTree(self.points)


@dataclass(frozen=True)
class Comparison:
    """How two clouds lie on one another.

    Attributes:
        covisible: share of the points that the other end could see.
        overlap: share of these that lie at a surface of the other end.
        residual: median distance of those from the surface's plane, in median depths.
    """

    covisible: float
    overlap: float
    residual: float


def make_cloud(end: End, config: ClosuresConfig) -> EndCloud:
    """Collect the confident points of the frames around the matched one.

    Raises:
        DegenerateGeometryError: there are hardly any.
    """
    rows = frames_around(end, 2 * config.cloud_frames + 1)
    prediction, unit = end.prediction, end.median_depth
    far = config.max_range * unit
    depths = np.stack([_used(prediction.depth[i], prediction.confidence[i], far) for i in rows])
    poses = [Sim3.from_matrix(prediction.window_from_cam[i]) for i in rows]
    parts = []
    for depth, i, pose in zip(depths, rows, poses, strict=True):
        points = unproject(depth, prediction.intrinsics[i]).reshape(-1, 3)
        points = points[np.isfinite(points[:, 2])]
        parts.append(pose.apply(points[:: -(-len(points) // _MAX_PIXELS) or 1]))
    found = np.concatenate(parts)
    if len(found) < _MIN_POINTS:
        raise DegenerateGeometryError(f"window {end.window} has no depth near frame {end.frame}")
    cloud = _open3d_cloud(found / unit).voxel_down_sample(config.voxel)
    search = import_open3d().geometry.KDTreeSearchParamHybrid(_NORMAL_REACH * config.voxel, 30)
    cloud.estimate_normals(search)
    return EndCloud(
        unit * np.asarray(cloud.points),
        np.asarray(cloud.normals),
        depths,
        prediction.intrinsics[rows],
        [pose.inverse() for pose in poses],
        unit,
    )


def compare(a: EndCloud, b: EndCloud, a_from_b: Sim3, config: ClosuresConfig) -> Comparison:
    """Lay b's cloud on a's.

    A point counts only where the other end looked and nothing hides it: a surface behind another
    contradicts nothing, a surface where the other end looked through does.
    """
    num_seen, near = 0, []
    for here, there, there_from_here in ((a, b, a_from_b.inverse()), (b, a, a_from_b)):
        points = there_from_here.apply(here.points)
        depth = _seen_depth(there, points, config.max_distance)
        is_seen = np.isfinite(depth)
        num_seen += int(is_seen.sum())
        planes, is_near = surface_distances(there, points[is_seen], depth[is_seen], config)
        near.append(planes[is_near] / there.unit)
    distances = np.concatenate(near)
    return Comparison(
        num_seen / (len(a.points) + len(b.points)),
        len(distances) / num_seen if num_seen else 0.0,
        float(np.median(distances)) if len(distances) else float("nan"),
    )


def surface_distances(
    cloud: EndCloud, points: Array, depth: Array, config: ClosuresConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """Return (P,) distances of points from the nearest surface's plane, and which are near it.

    Args:
        cloud: the surfaces.
        points: (P, 3) in the cloud's axes and units.
        depth: (P,) of the points; far ones may be farther off.
        config: how far.
    """
    distance, nearest = cloud.tree.query(points)
    offsets = points - cloud.points[nearest]
    planes = np.abs(np.einsum("pi,pi->p", offsets, cloud.normals[nearest]))
    return planes, distance <= config.max_distance * np.maximum(cloud.unit, depth)


def _seen_depth(cloud: EndCloud, points: Array, tolerance: float) -> Array:
    """Return (P,) depth of points in a frame that looked at them, nothing hiding them; or NaN."""
    out = np.full(len(points), np.nan)
    height, width = cloud.depths.shape[1:]
    for depth, K, cam_from_window in zip(
        cloud.depths, cloud.intrinsics, cloud.cam_from_window, strict=True
    ):
        x, y, z = cam_from_window.apply(points).T
        ahead = np.flatnonzero(z > 1e-6 * cloud.unit)
        col = np.rint(K[0, 0] * x[ahead] / z[ahead] + K[0, 2])
        row = np.rint(K[1, 1] * y[ahead] / z[ahead] + K[1, 2])
        inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
        ahead = ahead[inside]
        known = depth[row[inside].astype(np.int64), col[inside].astype(np.int64)]
        seen = z[ahead] <= known + tolerance * np.maximum(cloud.unit, known)  # False where NaN
        out[ahead[seen]] = z[ahead[seen]]
    return out


def _used(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], far: float
) -> NDArray[np.float32]:
    """Return (H, W) depth where it is confident, near and on a surface; NaN elsewhere."""
    known = confidence > 0
    used = known & (depth <= far)
    if known.any():
        used &= confidence >= np.median(confidence[known])
    out = np.where(used, depth, np.nan).astype(np.float32)
    for axis in (0, 1):
        with np.errstate(invalid="ignore"):
            steps = np.abs(np.diff(np.log(depth), axis=axis)) > _EDGE
        edge = np.swapaxes(steps, 0, axis)
        view = np.swapaxes(out, 0, axis)
        view[1:][edge] = np.nan
        view[:-1][edge] = np.nan
    return out


def _open3d_cloud(points: Array) -> Any:
    o3d = import_open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
