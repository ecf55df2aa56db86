"""A rigid registration of two clouds on top of a measured similarity."""

from __future__ import annotations

import numpy as np

from laser_slam.closures.clouds import EndCloud
from laser_slam.closures.measurement import Measurement, moved_by
from laser_slam.config import ClosuresConfig
from laser_slam.dependencies import import_open3d
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array, Sim3, rotation_exp, rotation_log

_ITERATIONS = 30
_REACH = 0.1  # median depths, of a surface that a point lies at
_PATCH = 0.5  # median depths: points within a patch err together and count as one


def align_clouds(
    a: EndCloud, b: EndCloud, measurement: Measurement, pivot: Array, config: ClosuresConfig
) -> Sim3:
    """Lay b's cloud on a's, where the measurement leaves it open.

    Surfaces that slide along each other, as those of a street do, say nothing of that direction:
    what they do say is weighed against the measurement. The scale is the measurement's, for
    nearest points shrink clouds.

    Args:
        a: one end's surfaces.
        b: the other's.
        measurement: where to start, and how sure that is.
        pivot: (3,) centre of a's matched camera, in window a.
        config: how far surfaces may be apart.

    Returns:
        The rigid motion, in a's axes and units, to come after ``measurement.a_from_b``.

    Raises:
        DegenerateGeometryError: no surfaces are near each other.
    """
    to_unit = Sim3(1 / a.unit, np.eye(3), -pivot / a.unit)
    source = to_unit.apply(measurement.a_from_b.apply(b.points))
    target = to_unit.apply(a.points)
    found = _icp(source, target, a.normals, config)
    step = np.concatenate([rotation_log(found.rotation), found.translation])
    aligned = to_unit.inverse().apply(found.apply(source))
    known = _information(a, aligned, to_unit, max(measurement.residual, config.voxel / 4))
    prior = np.linalg.inv(_prior(measurement, pivot, a.unit))
    step = np.linalg.solve(known + prior, known @ step)
    return to_unit.inverse() @ Sim3(1.0, rotation_exp(step[:3]), step[3:]) @ to_unit


def displacement(motion: Sim3, points: Array, unit: float) -> tuple[float, float]:
    """Return how far a motion moves points, rms, in units, and how far it turns them, degrees."""
    moves = np.linalg.norm(motion.apply(points) - points, axis=1) / unit
    turn = float(np.degrees(np.linalg.norm(rotation_log(motion.rotation))))
    return float(np.sqrt((moves**2).mean())), turn


def _icp(source: Array, target: Array, normals: Array, config: ClosuresConfig) -> Sim3:
    """Register (P, 3) points with (Q, 3) surfaces: point to plane, Tukey's kernel."""
    o3d = import_open3d()
    tools = o3d.pipelines.registration
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (source, target)]
    clouds[1].normals = o3d.utility.Vector3dVector(normals)
    reach = 2 * config.max_distance
    kernel = tools.TukeyLoss(reach)
    result = tools.registration_icp(
        *clouds,
        reach,
        np.eye(4),
        tools.TransformationEstimationPointToPlane(kernel),
        tools.ICPConvergenceCriteria(max_iteration=_ITERATIONS),
    )
    if not len(result.correspondence_set):
        raise DegenerateGeometryError("no surfaces of the two ends are near each other")
    return Sim3.from_matrix(np.array(result.transformation))


def _information(a: EndCloud, points: Array, to_unit: Sim3, noise: float) -> Array:
    """Return (6, 6) what surfaces say of a small turn and move, in median depths.

    The noise is that of the depths, for surfaces that were laid on one another hide it: distorted
    depth bends both, and a registration takes some of the bend for motion.
    """
    distance, nearest = a.tree.query(points)
    is_near = distance <= _REACH * a.unit
    near, normals = to_unit.apply(points[is_near]), a.normals[nearest[is_near]]
    patches = len(np.unique(np.floor(near / _PATCH).astype(np.int64), axis=0))
    slopes = np.concatenate([np.cross(near, normals), normals], axis=1) / (1.4826 * noise)
    return np.asarray(slopes.T @ slopes * (patches / max(len(near), patches, 1)))


def _prior(measurement: Measurement, pivot: Array, unit: float) -> Array:
    """Return the (6, 6) covariance of the measurement at the pivot, in median depths."""
    carry = moved_by(pivot, measurement.a_from_b.translation)
    at_pivot = (carry @ measurement.covariance @ carry.T)[:6, :6]
    scale = np.repeat([1.0, 1 / unit], 3)
    return np.asarray(scale[:, None] * at_pivot * scale)
