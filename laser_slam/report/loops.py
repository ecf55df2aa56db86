"""Pictures of loops: the path with and without them, and the scale of the windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from laser_slam.report.style import (
    ACCENT,
    SECOND,
    WIDTH_PX,
    ground_plan,
    limits_around,
    mark_ends,
    picture,
)
from laser_slam.types import Trajectory

Array = NDArray[np.float64]
Pairs = NDArray[np.int64]

ACCEPTED = "#1a9850"
REJECTED = "#c0392b"
TRUTH = "#b4bcc4"
_HEAD_PX = 180  # of a panel: title, labels and legend


@dataclass(frozen=True)
class ScaleCurves:
    """Metres, or world units where there is no truth, per unit of each window.

    Attributes:
        distances: (N,) rising, of the windows along the path; metres, or world units.
        chained: (N,) by the registrations alone.
        closed: (N,) with the closures.
        truth: (N,) NaN: unknown; None: there is no truth.
    """

    distances: Array
    chained: Array
    closed: Array
    truth: Array | None


@dataclass(frozen=True)
class LoopPaths:
    """The path of a run with and without its loops.

    Attributes:
        chained: by the registrations alone; aligned to the truth, if there is one.
        closed: with the closures; aligned as well.
        truth: for all frames or some, in metres; None: there is none, and units are world units.
        accepted: (A, 2) frames of the pairs that were closed.
        rejected: (R, 2) frames of the candidates that were not.
    """

    chained: Trajectory
    closed: Trajectory
    truth: Trajectory | None
    accepted: Pairs
    rejected: Pairs


def loops_picture(path: Path, paths: LoopPaths) -> None:
    """Draw the path from above, by the chain alone and with the loops closed.

    Pairs of frames are joined by lines, which are long where the path misses its earlier self.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    known = [paths.chained, paths.closed] + ([paths.truth] if paths.truth is not None else [])
    low, high = limits_around(
        np.concatenate([ground_plan(trajectory) for trajectory in known]), 0.15
    )
    ratio = float((high[1] - low[1]) / (high[0] - low[0]))
    is_wide = ratio < 0.5
    columns, rows = (1, 2) if is_wide else (2, 1)
    height = rows * (float(np.clip(0.9 * WIDTH_PX / columns * ratio, 160, 1100)) + _HEAD_PX)
    unit = "world units" if paths.truth is None else "m"
    with picture(path, round(height)) as figure:
        panels = figure.subplots(rows, columns, sharex=True, sharey=True).ravel()
        for axes, estimate, title in zip(
            panels,
            (paths.chained, paths.closed),
            ("Without loops", "Loops closed"),
            strict=True,
        ):
            axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.set_title(title + _rmse_text(estimate, paths.truth))
            _draw_panel(axes, estimate, paths)
        for axes in panels if not is_wide else panels[1:]:
            axes.set_xlabel(f"x, right ({unit})")
        for axes in panels if is_wide else panels[:1]:
            axes.set_ylabel(f"z, forward ({unit})")
        _legend_below(figure, panels[0])


def scales_picture(path: Path, curves: ScaleCurves) -> None:
    """Draw the scale of each window over the distance, and how far it is off the truth.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    has_truth = curves.truth is not None
    unit = "m" if has_truth else "world units"
    with picture(path, 880 if has_truth else 520) as figure:
        panels = figure.subplots(2 if has_truth else 1, 1, sharex=True, squeeze=False)[:, 0]
        panels[0].set_title("Scale of the windows over the distance")
        panels[0].set_ylabel(f"{unit} per window unit")
        if curves.truth is not None:
            panels[0].plot(curves.distances, curves.truth, color=TRUTH, linewidth=5, label="truth")
            _draw_scales(panels[1], curves, 1 / curves.truth)
            panels[1].axhline(1, color=TRUTH, linewidth=3, zorder=1)
            panels[1].set_title("Share of the true scale")
            panels[1].yaxis.set_major_formatter(PercentFormatter(1.0))
        _draw_scales(panels[0], curves, np.ones(len(curves.distances)))
        panels[-1].set_xlabel(f"distance travelled ({unit})")
        _legend_below(figure, panels[0])


def _legend_below(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))


def _draw_scales(axes: Axes, curves: ScaleCurves, factor: Array) -> None:
    marks: dict[str, Any] = {"marker": "o", "ms": 3.5, "linewidth": 1.6}
    for values, color, label in (
        (curves.chained, ACCENT, "without loops"),
        (curves.closed, SECOND, "loops closed"),
    ):
        axes.plot(curves.distances, values * factor, color=color, label=label, **marks)


def _draw_panel(axes: Axes, estimate: Trajectory, paths: LoopPaths) -> None:
    if paths.truth is not None:
        axes.plot(*ground_plan(paths.truth).T, color=TRUTH, linewidth=4, label="truth", zorder=1)
    axes.plot(*ground_plan(estimate).T, color=SECOND, linewidth=1.8, label="estimate", zorder=3)
    rejected, accepted = (_lines(estimate, pairs) for pairs in (paths.rejected, paths.accepted))
    crowd = float(np.clip(60 / max(len(rejected), 1), 0.15, 0.8))
    _join(axes, rejected, f"rejected ({len(rejected)})", (REJECTED, 0.7, crowd, 2))
    _join(axes, accepted, f"closed ({len(accepted)})", (ACCEPTED, 1.8, 0.9, 4))
    mark_ends(axes, ground_plan(estimate))


def _join(axes: Axes, lines: Array, label: str, look: tuple[str, float, float, int]) -> None:
    """Draw (N, 2, 2) lines with their ends, which show where a line is too short to be seen."""
    color, width, alpha, order = look
    axes.add_collection(
        LineCollection(list(lines), colors=color, linewidths=width, alpha=alpha, zorder=order)
    )
    ends = lines.reshape(-1, 2)
    axes.scatter(ends[:, 0], ends[:, 1], s=6 * width, color=color, alpha=alpha, zorder=order)
    axes.plot([], [], color=color, linewidth=width, marker="o", ms=2.5 * width, label=label)


def _lines(estimate: Trajectory, pairs: Pairs) -> Array:
    """Return the (N, 2, 2) ends, from above, of the pairs whose frames have poses."""
    known = np.isin(pairs, estimate.frames).all(axis=1)
    rows = np.searchsorted(estimate.frames, pairs[known])
    return ground_plan(estimate)[rows].reshape(-1, 2, 2)


def _rmse_text(estimate: Trajectory, truth: Trajectory | None) -> str:
    if truth is None:
        return ""
    _, found, true = np.intersect1d(estimate.frames, truth.frames, return_indices=True)
    apart = estimate.world_from_cam[found, :3, 3] - truth.world_from_cam[true, :3, 3]
    if not len(apart):
        return ""
    return f": {np.sqrt(np.mean(np.sum(apart**2, axis=1))):.2f} m RMSE"


def frame_pairs(pairs: Sequence[tuple[int, int]]) -> Pairs:
    """Return (N, 2) frames, N may be 0."""
    return np.array(pairs, np.int64).reshape(-1, 2)
