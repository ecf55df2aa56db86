"""Scale, rotation and translation at once from all points of the shared frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Sim3, umeyama
from laser_slam.types import Prediction

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MAX_POINTS = 40_000  # of all shared frames
_GATE = 0.1  # of the lower median confidence
_ROUNDS = 5
_TOLERANCE = 1e-9  # relative


def fit_joint(
    previous: Prediction,
    current: Prediction,
    in_previous: Indices,
    in_current: Indices,
    huber_delta: float,
) -> Sim3:
    """Fit the similarity that brings the current window's points to the previous window's.

    Args:
        previous: the window before.
        current: the window to place; depth maps of the same size.
        in_previous: (K,) where the shared frames are in the previous window.
        in_current: (K,) where they are in the current one.
        huber_delta: where the loss bends, in median depths of the previous window.

    Returns:
        ``previous_from_current``.

    Raises:
        DegenerateGeometryError: the points do not determine it.

    Reference: VGGT-Long (arXiv:2507.16443). Differs: the bend knows no unit, points are thinned.
    """
    gate = _GATE * min(_median(previous, in_previous), _median(current, in_current))
    parts = [
        _shared_points(previous, current, (int(i), int(j)), (gate, len(in_previous)))
        for i, j in zip(in_previous, in_current, strict=True)
    ]
    target, source, trust = (np.concatenate(part) for part in zip(*parts, strict=True))
    if len(trust) < 3:
        raise DegenerateGeometryError(f"windows share {len(trust)} confident points, need 3")
    depth = previous.depth[in_previous]
    bend = huber_delta * float(np.median(depth[previous.confidence[in_previous] > gate]))
    found = umeyama(source, target, with_scale=True, weights=trust)
    cost = np.inf
    for _round in range(_ROUNDS):
        errors = np.linalg.norm(found.apply(source) - target, axis=1)
        weights = trust * bend / np.maximum(errors, bend)
        last, cost = cost, float(weights @ errors**2)
        if abs(last - cost) <= _TOLERANCE * cost:
            break
        found = umeyama(source, target, with_scale=True, weights=weights)
    return found


def _median(window: Prediction, frames: Indices) -> float:
    known = window.confidence[frames]
    known = known[known > 0]
    return float(np.median(known)) if len(known) else 0.0


def _shared_points(
    previous: Prediction, current: Prediction, places: tuple[int, int], limits: tuple[float, int]
) -> tuple[Array, Array, Array]:
    """Return (P, 3) points of a frame in both windows' frames and units, and (P,) their trust."""
    (i, j), (gate, num_frames) = places, limits
    ours, theirs = current.confidence[j], previous.confidence[i]
    chosen = np.flatnonzero((ours > gate) & (theirs > gate))
    step = -(-len(chosen) * num_frames // _MAX_POINTS) or 1
    rows, cols = np.divmod(chosen[::step], ours.shape[1])
    trust = np.sqrt(ours[rows, cols].astype(np.float64) * theirs[rows, cols])
    return _points(previous, i, rows, cols), _points(current, j, rows, cols), trust


def _points(window: Prediction, index: int, rows: Indices, cols: Indices) -> Array:
    K = window.intrinsics[index]
    z = window.depth[index][rows, cols].astype(np.float64)
    in_cam = np.stack([(cols - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z], axis=1)
    return Sim3.from_matrix(window.window_from_cam[index]).apply(in_cam)
