"""The paths of a run from above, and their errors, as the report keeps them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation.trajectory import TrajectoryErrors, align
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

MAX_POINTS = 1000  # of a path in the report; more than a page can show
_DIGITS = 5  # of a coordinate, relative to the extent of the paths


def on_truth(
    paths: Sequence[Trajectory], truth: Trajectory | None
) -> tuple[list[Trajectory], Trajectory | None, list[float]]:
    """Align paths to the truth, each by its own Sim(3); without one they stay.

    Args:
        paths: in world units.
        truth: in metres; None: there is none.

    Returns:
        The paths, in metres if the truth is; the truth, None where it determines nothing; and
        metres per world unit of each path, or ones.
    """
    if truth is None:
        return list(paths), None, [1.0] * len(paths)
    aligned, scales = [], []
    try:
        for path in paths:
            truth_from_world = align(path, truth, with_scale=True)
            poses = truth_from_world.apply_poses(path.world_from_cam)
            aligned.append(replace(path, world_from_cam=poses))
            scales.append(truth_from_world.scale)
    except DegenerateGeometryError:
        return list(paths), None, [1.0] * len(paths)
    return aligned, truth, scales


def describe_paths(
    estimate: Trajectory,
    without_loops: Trajectory | None,
    truth: Trajectory | None,
    errors: tuple[TrajectoryErrors | None, TrajectoryErrors | None],
) -> dict[str, Any]:
    """Keep x (right) and z (forward) of the paths, and the position errors along the true one.

    Long paths are thinned to ``MAX_POINTS`` frames, errors too.

    Args:
        estimate: a pose for every frame, with the loops closed.
        without_loops: by the registrations alone; None: loops were not looked for.
        truth: poses in metres; None: there is none.
        errors: of both, from ``evaluate_trajectory``; None: there is no truth.
    """
    given = [estimate] if without_loops is None else [estimate, without_loops]
    paths, used_truth, _ = on_truth(given, truth)
    known = np.concatenate([path.world_from_cam[:, [0, 2], 3] for path in paths])
    extent = float(np.ptp(known, axis=0).max(initial=0)) if len(known) else 0.0
    decimals = _DIGITS - int(np.ceil(np.log10(extent))) if extent > 0 else _DIGITS
    return {
        "unit": "world units" if used_truth is None else "m",
        "estimate": _columns(paths[0], decimals),
        "without_loops": None if without_loops is None else _columns(paths[1], decimals),
        "truth": None if used_truth is None else _columns(used_truth, decimals),
        "errors": {
            name: None if of is None or not len(of.errors_m) else _error_columns(of)
            for name, of in zip(("estimate", "without_loops"), errors, strict=True)
        },
    }


def _columns(path: Trajectory, decimals: int) -> dict[str, list[Any]]:
    rows = _thinned(len(path.frames))
    x, z = np.round(path.world_from_cam[rows][:, [0, 2], 3].T, decimals).tolist()
    return {"frames": path.frames[rows].tolist(), "x": x, "z": z}


def _error_columns(errors: TrajectoryErrors) -> dict[str, list[Any]]:
    rows = _thinned(len(errors.frames))
    columns = {
        "distance_m": errors.distances_m,
        "error_m": errors.errors_m,
        "drift_from_start_m": errors.drift_m,
    }
    return {name: np.round(values[rows], 4).tolist() for name, values in columns.items()}


def _thinned(num: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, max(num - 1, 0), min(num, MAX_POINTS)).round().astype(np.int64))
