"""The common look of all pictures, and their way to the disk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from laser_slam.store import atomic_write
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

DPI = 150
WIDTH_PX = 1200
INK = "#22303c"
MUTED = "#8a96a3"
PAPER = "#ffffff"
ACCENT = "#e4572e"
SECOND = "#17769c"

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 11.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 9,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e6eaee",
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "#e6eaee",
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
}


@contextmanager
def picture(path: Path, height_px: int, *, layout: str | None = "constrained") -> Iterator[Figure]:
    """Yield an empty figure, 1200 pixels wide, that becomes the PNG file ``path`` at the end.

    Raises:
        RunFolderError: the folder is missing, cannot be written or is full.
    """
    with rc_context(_STYLE):
        options: Any = {"layout": layout}
        figure = Figure(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, **options)
        FigureCanvasAgg(figure)
        engine = figure.get_layout_engine()
        if isinstance(engine, ConstrainedLayoutEngine):
            engine.set(w_pad=0.13, h_pad=0.13)  # inches
        yield figure
        with atomic_write(path) as partial:
            figure.savefig(partial, format="png", dpi=DPI)


def round_length(length: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20 ... that is not above ``length``.

    >>> [round_length(value) for value in (0.3, 7.0, 1999.0)]
    [0.2, 5.0, 1000.0]
    """
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))


def mark_ends(axes: Axes, path: NDArray[np.float64]) -> None:
    """Mark the first and the last of (N, 2) places, with entries for the legend."""
    marks: dict[str, Any] = {"s": 64, "zorder": 5, "edgecolors": "white", "linewidths": 1.5}
    axes.scatter(path[:1, 0], path[:1, 1], marker="o", color=INK, label="start", **marks)
    axes.scatter(path[-1:, 0], path[-1:, 1], marker="s", color=ACCENT, label="end", **marks)


def ground_plan(trajectory: Trajectory) -> Array:
    """Return the (N, 2) x and z of the camera centres."""
    return trajectory.world_from_cam[:, [0, 2], 3]


def limits_around(points: Array, least: float) -> tuple[Array, Array]:
    """Return lower and upper corner around (N, 2) points, with a margin.

    Args:
        points: of a path.
        least: half of the width, in extents, that even a straight path gets.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(max((high - low).max(), 1e-9))
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, least * extent) + 0.06 * extent
    return middle - half, middle + half
