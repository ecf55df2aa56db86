"""What a person sees of a run: progress with rate and time left, warnings, a short summary."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table
from rich.text import Text

from laser_slam.bookkeeping import Progress, no_progress

SECONDS_BETWEEN_LINES = 10.0
logger = logging.getLogger(__name__)


@contextmanager
def progress_display(*, quiet: bool) -> Iterator[Progress]:
    """Show a run on standard error: bars on a terminal, plain lines elsewhere.

    Args:
        quiet: only warnings.

    Yields:
        What a pipeline reports its progress to.
    """
    console = Console(stderr=True)
    if not quiet and console.is_terminal:
        bars = Bars(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _RateColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
        )
        with _logging_to(RichHandler(console=console, show_path=False), logging.INFO), bars:
            yield _BarProgress(bars)
    else:
        lines = logging.StreamHandler(console.file)
        lines.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
        with _logging_to(lines, logging.WARNING if quiet else logging.INFO):
            yield no_progress if quiet else _LineProgress()


def print_summary(report: dict[str, Any], folder: Path) -> None:
    """Print the result in a few lines on standard output."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in summarize(report):
        table.add_row(name, Text(value))
    points = f"{report['map']['num_points']:,} points"
    table.add_row("map", Text(f"{folder / 'map.ply'}, {points}"))
    table.add_row("report", Text(str(folder / "report.html")))
    Console(soft_wrap=True).print(table)


def summarize(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Give the lines of the summary: a name, and a value with its unit."""
    frames, windows = report["frames"], report["windows"]
    unreadable = f", {frames['unreadable']} unreadable" if frames["unreadable"] else ""
    yield "frames", f"{frames['read']}{unreadable}, {frames['keyframes']} keyframes"
    bridged = f", {len(windows['bridged'])} bridged" if windows["bridged"] else ""
    yield "windows", f"{windows['num']}{bridged}"
    if report["trajectory"]:
        yield from _summarize_trajectory(report["trajectory"])
    if report.get("closures"):  # a report of an older version has none
        yield "loops", _loops_in_words(report["closures"])
    if report["depth"]:
        scores = report["depth"]["by_trajectory_scale"] or report["depth"]["by_median_ratio"]
        if scores["abs_rel"] is not None:
            share = f"over the {scores['coverage']:.0%} of pixels that are confident"
            yield "depth AbsRel", f"{scores['abs_rel']:.3f} {share}"
    yield "speed", f"{report['frames_per_second']:.1f} frames/s"


def _summarize_trajectory(errors: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if errors["reason"]:
        yield "trajectory", f"not scored: {errors['reason']}"
        return
    rmse = errors["ate_sim3_m"]["rmse"]
    yield "ATE (Sim(3))", f"{rmse:.3f} m RMSE over {errors['path_length_m']:.0f} m"
    kitti = errors["kitti"]
    if kitti["t_rel_percent"] is not None:
        turn = f"{kitti['r_rel_deg_per_100m']:.2f} deg/100 m"
        yield "t_rel, r_rel", f"{kitti['t_rel_percent']:.2f} %, {turn}"


def _loops_in_words(closures: dict[str, Any]) -> str:
    counts = f"{closures['accepted']} closed of {closures['candidates']} candidates"
    without = closures["trajectory_without"]
    if not closures["accepted"] or not without or without["reason"]:
        return counts
    return f"{counts}; ATE without them {without['ate_sim3_m']['rmse']:.3f} m"


class _RateColumn(ProgressColumn):
    def render(self, task: Task) -> Text:
        """Show how many are done in a second."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f}/s")


class _BarProgress:
    """One bar a stage."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)


class _LineProgress:
    """A line every few seconds, and one at the end of a stage."""

    def __init__(self) -> None:
        self._stage = ""
        self._start_s = self._last_s = 0.0

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        now_s = time.monotonic()
        if stage != self._stage:
            self._stage, self._start_s, self._last_s = stage, now_s, now_s
        if done == total or now_s - self._last_s >= SECONDS_BETWEEN_LINES:
            self._last_s = now_s
            of = "" if total is None else f" of {total}"
            logger.info("%s: %d%s, %.0f s", stage, done, of, now_s - self._start_s)


@contextmanager
def _logging_to(handler: logging.Handler, level: int) -> Iterator[None]:
    package = logging.getLogger("laser_slam")
    before = package.level
    handler.setLevel(level)
    package.setLevel(logging.INFO)
    package.addHandler(handler)
    try:
        yield
    finally:
        package.removeHandler(handler)
        package.setLevel(before)
