"""The numbers of a finished run."""

from __future__ import annotations

import json
import math
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam import __version__
from laser_slam.slam import Node
from laser_slam.store import write_text
from laser_slam.types import Calibration, Cloud, SequenceInfo, Trajectory

Array = NDArray[np.float64]

PACKAGES = (
    "numpy",
    "numba",
    "opencv-python-headless",
    "open3d",
    "poselib",
    "scipy",
    "gtsam",
    "torch",
)


@dataclass(frozen=True)
class Results:
    """What a run gives.

    Attributes:
        folder: where all of it lies.
        trajectory: a pose for every frame of the input.
        cloud: the map, in world units.
        report: all numbers, as in ``report.json``.
    """

    folder: Path
    trajectory: Trajectory
    cloud: Cloud
    report: dict[str, Any]


def describe_sequence(
    info: SequenceInfo, calibration: Calibration, intrinsics: Sequence[Array]
) -> dict[str, Any]:
    """Describe the input, and with which calibration it was taken.

    Args:
        info: what the data set knows.
        calibration: what the run took for the camera, lens included.
        intrinsics: (3, 3) of each window, in pixels of rectified images, as the backbone used them.
    """
    return {
        "name": info.name,
        "height": info.size[0],
        "width": info.size[1],
        "has_truth": info.truth is not None,
        "intrinsics": _four_numbers(np.median(intrinsics, axis=0)),
        "intrinsics_given": None if info.intrinsics is None else _four_numbers(info.intrinsics),
        "intrinsics_source": info.intrinsics_source,
        "calibration": calibration.source,
        "distortion": [round(float(k), 6) for k in calibration.distortion],
    }


def _four_numbers(intrinsics: Array) -> dict[str, float]:
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return {name: round(float(intrinsics[place]), 4) for name, place in places.items()}


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report as JSON; what is not a number becomes null, for JSON knows no NaN.

    Raises:
        RunFolderError: the file cannot be written.
    """
    write_text(path, json.dumps(_without_nan(report), indent=2, ensure_ascii=False) + "\n")


def describe_system() -> dict[str, Any]:
    """Tell what the run needed of the computer, and what its results may depend on."""
    return {"peak_memory_mib": _peak_memory_mib(), "versions": _versions()}


def _versions() -> dict[str, str]:
    out = {"laser-slam": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            continue
    return {**out, "system": platform.platform()}


def _peak_memory_mib() -> float | None:
    """Return the largest memory that this process had so far; None where the system can't tell."""
    try:
        import resource  # noqa: PLC0415  (not on every system)
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _without_nan(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def describe_layers(nodes: Sequence[Node]) -> dict[str, Any] | None:
    """Sum up what became of the layers; None: they were not looked at.

    Args:
        nodes: the places of all windows.
    """
    counts = [node.layers for node in nodes if node.layers is not None]
    if not counts:
        return None
    before = [c.mismatch_before for c in counts if c.mismatch_before is not None]
    after = [c.mismatch_after for c in counts if c.mismatch_after is not None]
    names = ("layers", "linked", "refused", "reached")
    return {
        **{name: sum(getattr(c, name) for c in counts) for name in names},
        "median_mismatch_before": float(np.median(before)) if before else None,
        "median_mismatch_after": float(np.median(after)) if after else None,
        "windows": {str(node.index): asdict(node.layers) for node in nodes if node.layers},
    }
