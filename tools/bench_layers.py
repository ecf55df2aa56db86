"""Time registration and layer-wise scale alignment beside scikit-image's felzenszwalb.

python tools/bench_layers.py                                     both sizes, one core and two
python tools/bench_layers.py --config official --rounds 11

All are timed in turn, round after round on the same 20 frames, and the ratio is the median of the
rounds' ratios: a busy machine slows all alike. The first window has corrections of its own, as
every window but the first of a run.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from ablate_street import print_table, read_settings
from numpy.typing import NDArray
from street import CASES, KITTI_SIZE, TALL_SIZE, Pair, make_pair

from laser_slam.config import Config
from laser_slam.errors import LaserSlamError
from laser_slam.layers import align_layers, apply_layers, first_layers, make_segmenter
from laser_slam.registration import register
from laser_slam.types import Layers, Prediction

try:
    from skimage.segmentation import felzenszwalb
except ImportError:
    felzenszwalb = None

Array = NDArray[np.float64]

STAGES = ("register", "segment", "align", "apply")
# What runs, and its share of the yardstick's CPU time that it may take.
TARGETS = {"default,layers.segmentation.downscale=1": 0.14, "default": 0.07}


@dataclass(frozen=True)
class Result:
    """Times of one setting on some cores.

    Attributes:
        cpu: (rounds, 4) seconds of all threads, by stage.
        wall: (rounds, 4) seconds, by stage.
        yardstick: (rounds, 2) CPU and wall seconds of felzenszwalb in the same rounds.
    """

    cpu: Array
    wall: Array
    yardstick: Array

    def cells(self, target: float | None) -> list[str]:
        """Write the times as a row of the table."""
        by_cpu = np.median(self.cpu.sum(axis=1) / self.yardstick[:, 0])
        by_wall = np.median(self.wall.sum(axis=1) / self.yardstick[:, 1])
        verdict = "" if target is None else f" ({'≤' if by_cpu <= target else '>'} {target:.2f})"
        totals = [self.cpu.sum(axis=1), self.wall.sum(axis=1), *self.yardstick.T]
        times = [*totals[:2], *self.cpu.T, *totals[2:]]
        milliseconds = [f"{1000 * np.median(part):.0f}" for part in times]
        return [f"{by_cpu:.3f}{verdict}", f"{by_wall:.3f}", *milliseconds]


COLUMNS = (
    "size",
    "cores",
    "settings",
    "CPU ratio",
    "wall ratio",
    "CPU ms",
    "wall ms",
    *(f"{stage} CPU ms" for stage in STAGES),
    "felzenszwalb CPU ms",
    "felzenszwalb wall ms",
)


def stages(pair: Pair, config: Config) -> Callable[[], list[tuple[float, float]]]:
    """Prepare one step of a run; what comes back runs it and returns CPU and wall by stage."""
    segmenter = make_segmenter(config.layers.segmentation)
    colors = pair.colors(pair.current)
    before = (pair.previous, _layers_in_a_chain(pair, config))

    def step() -> list[tuple[float, float]]:
        clock = [_now()]
        registration = register(pair.previous, pair.current, config.registration)
        clock.append(_now())
        labels = segmenter.segment(pair.current, colors)
        clock.append(_now())
        scale = registration.previous_from_current.scale
        layers, _ = align_layers(before, pair.current, labels, scale, config.layers)
        clock.append(_now())
        apply_layers(pair.current, layers, config.layers)
        clock.append(_now())
        return [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(clock)]

    return step


def _layers_in_a_chain(pair: Pair, config: Config) -> Layers:
    """Return layers of the first window that change its depth as those of a chain would."""
    segmenter = make_segmenter(config.layers.segmentation)
    first = first_layers(segmenter.segment(pair.previous, pair.colors(pair.previous)))
    labels = segmenter.segment(pair.current, pair.colors(pair.current))
    scale = register(pair.previous, pair.current, config.registration).previous_from_current.scale
    layers, _ = align_layers((pair.previous, first), pair.current, labels, scale, config.layers)
    scales = np.exp(0.01 * np.random.default_rng(0).normal(size=len(first.scales)))
    return replace(first, scales=scales, curve=layers.curve * np.array([scale, 1.0]))


def _now() -> tuple[float, float]:
    return time.process_time(), time.perf_counter()


def _time_yardstick(window: Prediction) -> tuple[float, float]:
    """Run felzenszwalb as the official code does: raw depth, one thread, for it holds the GIL."""
    start = _now()
    for depth in window.depth:
        felzenszwalb(depth, scale=300, sigma=1.1, min_size=500)
    end = _now()
    return end[0] - start[0], end[1] - start[1]


def _keep_to(cores: int) -> None:
    """Let all threads that there are, and those that they start, run on so many cores."""
    allowed = set(sorted(_ALL_CORES)[:cores])
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has just ended
            os.sched_setaffinity(int(task.name), allowed)
    cv2.setNumThreads(cores)


_ALL_CORES = os.sched_getaffinity(0)


def bench(
    size: tuple[int, int], cores: int, configs: dict[str, Config], rounds: int
) -> list[Result]:
    """Time all settings in turn on one pair of windows."""
    _keep_to(cores)
    pair = make_pair(CASES["objects, noise 1 %"], 0, size)
    steps = [stages(pair, config) for config in configs.values()]
    for step in steps:  # compile, fill caches
        step()
    times = np.empty((rounds, len(steps), len(STAGES), 2))
    yardstick = np.empty((rounds, 2))
    for k in range(rounds):
        yardstick[k] = _time_yardstick(pair.current)
        for i, step in enumerate(steps):
            times[k, i] = step()
    return [Result(times[:, i, :, 0], times[:, i, :, 1], yardstick) for i in range(len(steps))]


def main(
    settings: Annotated[
        list[str] | None,
        typer.Option("--config", help="more settings: name or file; ',key=value' may follow"),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="that the medians are over")] = 7,
    cores: Annotated[str, typer.Option(help="how many, comma-separated")] = "1,2",
    markdown: Annotated[bool, typer.Option("--markdown", help="print Markdown")] = False,
) -> None:
    """Print CPU and wall time of a window of 20 frames, and their ratio to felzenszwalb's."""
    if felzenszwalb is None:
        typer.echo("bench_layers: the yardstick is missing: pip install scikit-image", err=True)
        raise typer.Exit(1)
    try:
        configs = {name: read_settings(name, []) for name in [*TARGETS, *(settings or [])]}
    except LaserSlamError as error:
        typer.echo(f"bench_layers: {error}", err=True)
        raise typer.Exit(1) from error
    rows = []
    for size in (KITTI_SIZE, TALL_SIZE):
        for num in (int(text) for text in cores.split(",")):
            place = [f"{size[1]}x{size[0]}", str(min(num, len(_ALL_CORES)))]
            results = bench(size, num, configs, rounds)
            for name, result in zip(configs, results, strict=True):
                rows.append([*place, name, *result.cells(TARGETS.get(name))])
    title = "Registration + layer-wise scale alignment, window of 20 frames, medians"
    print_table(COLUMNS, rows, title, markdown=markdown)


if __name__ == "__main__":
    typer.run(main)
