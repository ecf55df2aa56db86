"""The one place where our Sim(3) and GTSAM's meet: maps, tangents and their uncertainty.

GTSAM's ``Similarity3(R, t, s)`` acts as ``s * (R @ p + t)``, ours as ``s * R @ p + t``: one group,
another translation. Its factors measure errors as ``found = measured * Expmap(error)``: rotation,
translation, log-scale in the axes and units of the *second* node, whereas the sigmas of a
``Registration`` are in those of the first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.dependencies import import_gtsam
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Sim3

Array = NDArray[np.float64]

DIMENSIONS = 7  # rotation 3, translation 3, log-scale 1


def to_gtsam(b_from_a: Sim3) -> Any:
    """Return the ``gtsam.Similarity3`` that moves points as ``b_from_a`` does."""
    gtsam = import_gtsam()
    scale = b_from_a.scale
    return gtsam.Similarity3(gtsam.Rot3(b_from_a.rotation), b_from_a.translation / scale, scale)


def from_gtsam(b_from_a: Any) -> Sim3:
    """Return the Sim3 that moves points as a ``gtsam.Similarity3`` does."""
    scale = b_from_a.scale()
    return Sim3(scale, b_from_a.rotation().matrix(), scale * b_from_a.translation())


def local_information(a_from_b: Sim3, sigmas: Array) -> Array:
    """Return the (7, 7) inverse covariance in GTSAM's tangent at a measured similarity.

    From ``R Exp(local) = Exp(parent) R`` and ``t + s R local = t + parent``: rotations turn back
    into b's axes, translations do too and change their unit. Where the sigmas of an axis differ,
    the turn correlates them, so the result is no diagonal.

    Args:
        a_from_b: measured.
        sigmas: (7,) as in ``Registration.sigmas``: rotation in a's axes (radians), translation in
            a's axes and units, log-scale.

    Raises:
        DegenerateGeometryError: the sigmas are not seven positive finite numbers.
    """
    values = np.asarray(sigmas, dtype=np.float64)
    if values.shape != (DIMENSIONS,) or not (np.isfinite(values) & (values > 0)).all():
        raise DegenerateGeometryError(
            f"a link of the pose graph needs 7 positive finite sigmas, got {values.tolist()}"
        )
    whitened_from_local = _parent_from_local(a_from_b) / values[:, None]
    return np.asarray(whitened_from_local.T @ whitened_from_local)


def parent_sigmas(a_from_b: Sim3, covariance: Array) -> Array:
    """Return the (7,) sigmas, as in ``Registration.sigmas``, of a covariance in GTSAM's tangent."""
    turn = _parent_from_local(a_from_b)
    return np.asarray(np.sqrt(np.diagonal(turn @ covariance @ turn.T)))


def _parent_from_local(a_from_b: Sim3) -> Array:
    out = np.eye(DIMENSIONS)
    out[:3, :3] = a_from_b.rotation
    out[3:6, 3:6] = a_from_b.scale * a_from_b.rotation
    return out
