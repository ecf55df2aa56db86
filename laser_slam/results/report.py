"""The numbers of a finished run."""

from __future__ import annotations

import json
import math
import platform
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam import __version__
from laser_slam.slam import Node
from laser_slam.store import WindowFiles, write_text
from laser_slam.types import Calibration, Cloud, Layers, SequenceInfo, Trajectory

Array = NDArray[np.float64]

# A line break cannot be part of a text in JSON.
_LIST_OF_NUMBERS = re.compile(r"\[\n\s+((?:(?:null|[-+.eE\d]+),?\s+)+)\]")

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
        cloud: the map, in world units; of a large one an even part, ``map.ply`` has it all.
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

    Lists of numbers stay on one line.

    Raises:
        RunFolderError: the file cannot be written.
    """
    text = json.dumps(_without_nan(report), indent=2, ensure_ascii=False)
    write_text(path, _LIST_OF_NUMBERS.sub(_on_one_line, text) + "\n")


def _on_one_line(found: re.Match[str]) -> str:
    return f"[{' '.join(found[1].split())}]"


def describe_system() -> dict[str, Any]:
    """Tell what the run needed of the computer, and what its results may depend on."""
    return {
        "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
        "peak_memory_mib": _peak_memory_mib(),
        "versions": _versions(),
    }


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


def describe_layers(
    nodes: Sequence[Node], files: WindowFiles | None = None
) -> dict[str, Any] | None:
    """Sum up what became of the layers; None: they were not looked at.

    Args:
        nodes: the places of all windows.
        files: of the run, for the scales that the layers have at its end; None: left out.
    """
    counts = {node.index: node.layers for node in nodes if node.layers is not None}
    if not counts:
        return None
    before = [c.mismatch_before for c in counts.values() if c.mismatch_before is not None]
    after = [c.mismatch_after for c in counts.values() if c.mismatch_after is not None]
    names = ("layers", "linked", "refused", "reached")
    scales = {i: layer_scales(files.load_layers(i)) if files else None for i in counts}
    return {
        **{name: sum(getattr(c, name) for c in counts.values()) for name in names},
        "median_mismatch_before": float(np.median(before)) if before else None,
        "median_mismatch_after": float(np.median(after)) if after else None,
        "windows": {str(i): {**asdict(c), "scales": scales[i]} for i, c in counts.items()},
    }


def layer_scales(layers: Layers) -> dict[str, float] | None:
    """Return percentiles of the layers' scales, by their area; None: nothing has a depth.

    >>> labels = np.array([[[1, 1, 1, 2]]], np.uint16)
    >>> ones = np.ones(2)
    >>> layers = Layers(labels, np.array([0, 2]), np.array([1.1, 0.5]), ones, np.empty((0, 2)))
    >>> layer_scales(layers)
    {'p5': 0.5, 'p50': 1.1, 'p95': 1.1}
    """
    area = np.zeros(len(layers.scales))
    for labels, start, end in zip(layers.labels, layers.starts, layers.starts[1:], strict=False):
        area[start:end] = np.bincount(labels.ravel(), minlength=end - start + 1)[1:]
    order = np.argsort(layers.scales)
    shares = np.cumsum(area[order])
    if not area.sum():
        return None
    rows = np.searchsorted(shares, np.array([0.05, 0.5, 0.95]) * shares[-1])
    found = layers.scales[order][rows]
    return {name: float(value) for name, value in zip(("p5", "p50", "p95"), found, strict=True)}
