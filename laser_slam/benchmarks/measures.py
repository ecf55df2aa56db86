"""What a column shows: where the number comes from, and how it is written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Scores = Mapping[str, Any]
Better = Literal["lower", "higher"]

PROTOCOL_VERSION = 2  # rises when a protocol's numbers change, so that kept ones are not taken
POINTS = ("indoor", "7scenes", "nrgbd", "outdoor", "waymo")  # protocols of point maps


@dataclass(frozen=True)
class Measure:
    """A number of a run.

    Attributes:
        protocol: what works it out; ``run``: the run itself, as in its report.
        path: where it stands in the result of the protocol, as ``a.b.c``.
        digits: after the point.
        factor: that it is written with, such as 100 for percent.
        better: which numbers are; None: it says what a run is, not how good it is.
    """

    protocol: str
    path: str
    digits: int = 3
    factor: float = 1.0
    better: Better | None = "lower"


MEASURES = {
    "ate_m": Measure("run", "trajectory.ate_sim3_m.rmse"),
    "ate_without_loops_m": Measure("run", "closures.trajectory_without.ate_sim3_m.rmse"),
    "rpe_translation_m": Measure("run", "trajectory.rpe_translation_m.rmse"),
    "rpe_rotation_deg": Measure("run", "trajectory.rpe_rotation_deg.rmse"),
    "t_rel_percent": Measure("run", "trajectory.kitti.t_rel_percent", 2),
    "r_rel_deg_per_100m": Measure("run", "trajectory.kitti.r_rel_deg_per_100m"),
    "path_m": Measure("run", "trajectory.path_length_m", 0, better=None),
    "sampled_abs_rel": Measure("run", "depth.by_median_ratio.abs_rel"),
    "sampled_delta_percent": Measure("run", "depth.by_median_ratio.delta_125", 1, 100.0, "higher"),
    "coverage_percent": Measure("run", "depth.by_median_ratio.coverage", 0, 100.0, None),
    "loops": Measure("run", "closures.accepted", 0, better=None),
    "candidates": Measure("run", "closures.candidates", 0, better=None),
    "frames": Measure("run", "frames.read", 0, better=None),
    "bridged": Measure("run", "windows.num_bridged", 0, better=None),
    "frames_per_s": Measure("run", "frames_per_second", 2, better=None),
    **{
        f"{name}_{measure}": Measure(f"video_depth_{name}", *rest)
        for name in ("sintel", "bonn", "kitti")
        for measure, *rest in (
            ("abs_rel", "abs_rel"),
            ("delta_percent", "delta_125", 1, 100.0, "higher"),
            ("pixels_percent", "coverage", 1, 100.0, None),
        )
    },
    **{
        f"{name}_{measure}": Measure(f"points_{name}", *rest)
        for name in POINTS
        for measure, *rest in (
            ("pixels_percent", "coverage", 1, 100.0, None),
            ("acc_m", "acc_mean_m"),
            ("acc_median_m", "acc_median_m"),
            ("comp_m", "comp_mean_m"),
            ("comp_median_m", "comp_median_m"),
            ("nc", "nc_mean", 3, 1.0, "higher"),
            ("nc_median", "nc_median", 3, 1.0, "higher"),
            ("chamfer_m", "chamfer_m"),
        )
    },
}
"""Name in a table -> what it is."""


def look_up(scores: Scores, measure: Measure) -> float | None:
    """Return a number of a run, without its factor; None: it has none.

    >>> look_up({"run": {"frames": {"read": 3}}}, MEASURES["frames"])
    3.0
    """
    return _number(scores.get(measure.protocol), measure.path)


def weight(scores: Scores, measure: Measure) -> float:
    """Return what a run weighs in a mean: a video's depth its pixels with truth, all else 1."""
    num = _number(scores.get(measure.protocol), "num_true_pixels")
    return num if num else 1.0


def why_missing(scores: Scores, measure: Measure) -> str:
    """Say why a run has no such number."""
    found = scores.get(measure.protocol)
    if not isinstance(found, Mapping):
        return f"{measure.protocol} was not worked out"
    first = measure.path.split(".")[0]
    part = found.get(first)
    for place in (found, part):
        if isinstance(place, Mapping) and place.get("reason"):
            return str(place["reason"])
    return _LACKS.get(first, f"the run says nothing of {first}") if part is None else _TOO_SHORT


def remarks(scores: Scores) -> tuple[str, ...]:
    """Say what the numbers of a run are not over: frames without a pose, frames without depth.

    >>> remarks({"run": {"trajectory": {"num_frames": 40, "num_truth": 90}}})
    ('50 of 90 frames with a true pose have none and are not scored',)
    """
    found = []
    posed = (_number(scores.get("run"), f"trajectory.num_{of}") for of in ("frames", "truth"))
    num, num_truth = (int(each or 0) for each in posed)
    if num < num_truth:
        found.append(
            f"{num_truth - num} of {num_truth} frames with a true pose have none and are not scored"
        )
    for name, result in scores.items():
        num, num_truth = (int(_number(result, f"num_{of}") or 0) for of in ("predicted", "frames"))
        if num < num_truth:
            found.append(f"{name}: {num_truth - num} of {num_truth} frames have no depth")
    return tuple(found)


def _number(result: Any, path: str) -> float | None:
    """Return the finite number that stands at ``a.b.c`` of a protocol's result."""
    for key in path.split("."):
        result = result.get(key) if isinstance(result, Mapping) else None
    is_number = isinstance(result, int | float) and not isinstance(result, bool)
    return float(result) if is_number and math.isfinite(result) else None


_TOO_SHORT = "too little of it for this score"
_LACKS = {
    "trajectory": "no true poses",
    "depth": "no true depth",
    "closures": "closures are off",
}
