"""Pictures of the trajectory, its drift and the time that it took."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from laser_slam.report.style import (
    INK,
    MUTED,
    SECOND,
    WIDTH_PX,
    ground_plan,
    limits_around,
    mark_ends,
    picture,
)
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

_ERROR_COLORS = "plasma"


def trajectory_picture(path: Path, estimate: Trajectory, truth: Trajectory | None) -> None:
    """Draw the trajectory from above: x to the right, z forward, equal axes.

    With truth, both are in metres and the estimate is coloured by its distance to the truth of
    the same frame.

    Args:
        path: of the PNG file.
        estimate: already aligned to the truth, if there is one.
        truth: for all frames or some; None: there is none, and units are world units.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    known = [ground_plan(estimate)] + ([ground_plan(truth)] if truth is not None else [])
    low, high = limits_around(np.concatenate(known), 0.2)
    ratio = float((high[1] - low[1]) / (high[0] - low[0]))
    unit = "world units" if truth is None else "m"
    with picture(path, int(np.clip(0.8 * WIDTH_PX * ratio + 150, 620, 1500))) as figure:
        axes = figure.add_subplot(aspect="equal", title="Trajectory from above")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set(xlabel=f"x, right ({unit})", ylabel=f"z, forward ({unit})")
        if truth is not None:
            axes.plot(*ground_plan(truth).T, color="#b4bcc4", linewidth=4, label="truth", zorder=2)
            _draw_by_error(figure, axes, estimate, truth)
        else:
            axes.plot(*ground_plan(estimate).T, color=SECOND, linewidth=2, label="estimate")
        mark_ends(axes, ground_plan(estimate))
        axes.legend(loc="best")


def drift_picture(path: Path, distance_m: Array, error_m: Array, *, unit: str = "m") -> None:
    """Draw the position error over the distance travelled.

    Args:
        path: of the PNG file.
        distance_m: (N,) rising, metres, or world units if ``unit`` says so.
        error_m: (N,) in the same unit, NaN: unknown.
        unit: for the labels.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    with picture(path, 560) as figure:
        axes = figure.add_subplot(title="Drift over the distance travelled")
        axes.fill_between(distance_m, error_m, color=SECOND, alpha=0.15, linewidth=0)
        axes.plot(distance_m, error_m, color=SECOND, linewidth=2)
        if np.isfinite(error_m).any():
            _mark_rmse(axes, error_m, unit)
        axes.set(xlabel=f"distance travelled ({unit})", ylabel=f"position error ({unit})")
        axes.margins(x=0)
        axes.set_ylim(0, 1.15 * axes.get_ylim()[1])  # room for the legend


def stages_picture(path: Path, seconds_by_stage: Mapping[str, float]) -> None:
    """Draw how long each stage took, as horizontal bars in the order given.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    names, seconds = list(seconds_by_stage), np.array(list(seconds_by_stage.values()))
    total = float(seconds.sum()) if len(seconds) else 0.0
    with picture(path, 170 + 60 * max(len(names), 2)) as figure:
        axes = figure.add_subplot(title=f"Time by stage ({total:,.1f} s in all)")
        bars = axes.barh(names, seconds, color=SECOND, height=0.62)
        shares = seconds / total if total > 0 else np.zeros(len(names))
        texts = [f"{s:,.1f} s   {share:.0%}" for s, share in zip(seconds, shares, strict=True)]
        axes.bar_label(bars, labels=texts, padding=6, color=INK)
        axes.set_xlim(0, 1.25 * float(seconds.max()) if total > 0 else 1.0)
        axes.set_xlabel("seconds")
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")


def _draw_by_error(figure: Figure, axes: Axes, estimate: Trajectory, truth: Trajectory) -> None:
    _, in_estimate, in_truth = np.intersect1d(estimate.frames, truth.frames, return_indices=True)
    centers = estimate.world_from_cam[in_estimate, :3, 3]
    error = np.linalg.norm(centers - truth.world_from_cam[in_truth, :3, 3], axis=1)
    ground = ground_plan(estimate)[in_estimate]
    segments = np.stack([ground[:-1], ground[1:]], axis=1)
    line = LineCollection(list(segments), cmap=_ERROR_COLORS, linewidths=2.2, zorder=3)
    line.set_array((error[:-1] + error[1:]) / 2)
    line.set_clim(0, max(float(error.max(initial=0)), 1e-9))
    line.set_capstyle("round")
    axes.add_collection(line)
    rmse = float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")
    color = line.get_cmap()(0.35)
    axes.plot([], [], color=color, linewidth=2.2, label=f"estimate (RMSE {rmse:.2f} m)")
    bar = figure.colorbar(line, ax=axes, shrink=0.75, aspect=30, pad=0.02)
    bar.set_label("distance to the truth (m)")
    bar.outline.set_visible(False)


def _mark_rmse(axes: Axes, error_m: Array, unit: str) -> None:
    rmse = float(np.sqrt(np.nanmean(error_m**2)))
    label = f"RMSE {rmse:.2f} {unit}"
    axes.axhline(rmse, color=MUTED, linewidth=1.2, linestyle=(0, (5, 3)), label=label)
    axes.legend(loc="upper left")
