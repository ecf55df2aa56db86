"""Show a run: while it goes on, or afterwards from its folder."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.bookkeeping import Progress, no_progress
from laser_slam.closures import ClosureRecord, read_closures
from laser_slam.config import Config, load_config
from laser_slam.dependencies import import_open3d
from laser_slam.errors import DatasetError, DegenerateGeometryError, RunFolderError
from laser_slam.pose_graph import Link, PoseGraph, read_g2o
from laser_slam.pose_graph.tangent import parent_sigmas
from laser_slam.predicting.manifest import FRAMES_FILE, load_frames
from laser_slam.rescoring import read_trajectory
from laser_slam.results import CHAINED_FILE
from laser_slam.sim3 import Sim3
from laser_slam.slam import Slam, StoredWindow, read_window
from laser_slam.store import TileFiles, WindowFiles
from laser_slam.types import Cloud, Trajectory
from laser_slam.viewer import (
    BestEffortViewer,
    FileSink,
    RerunViewer,
    Sink,
    Viewer,
    WindowSink,
    has_display,
)

Array = NDArray[np.float64]

RECORDING = "run.rrd"
logger = logging.getLogger(__name__)


def live_viewer(folder: Path, config: Config) -> Viewer:
    """Return a viewer for a run that starts: a window, or ``run.rrd`` in its folder.

    Whatever becomes of the viewer, the run goes on.

    Args:
        folder: of the run, which need not be there yet.
        config: all settings.

    Raises:
        LaserSlamError: rerun is not installed, or its viewer does not start.
    """
    sink: Sink
    if has_display():
        sink = WindowSink()
    else:
        sink = FileSink(folder / RECORDING, replace=True)
        logger.info("no display: what there is to see goes to %s", folder / RECORDING)
    return BestEffortViewer(RerunViewer(sink, config.viewer, config.fusion))


def view_run(run: Path, sink: Sink, on_progress: Progress = no_progress) -> int:
    """Show a run as it went, from its folder: finished, or broken off.

    Windows are registered again and closures closed again, in their order, which takes a small
    part of a second each; nothing is predicted and no loop is looked for.

    Args:
        run: its folder; it is only read.
        sink: where it is shown.
        on_progress: called with a stage's name, how much is done and of how much.

    Returns:
        How many windows there are.

    Raises:
        RunFolderError: no run is there, or a file of it is damaged.
        LaserSlamError: it cannot be shown.
    """
    story = _Story(run)
    viewer = RerunViewer(sink, story.config.viewer, story.config.fusion)
    for index in range(story.num_windows):
        story.add(index, viewer)
        on_progress("viewing", index + 1, story.num_windows)
    story.end(viewer)
    viewer.close()
    return story.num_windows


class _Story:
    """A run told again, window by window."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self.config = _settings(run)
        self.num_windows = _count_windows(run)
        self._files = WindowFiles(run)
        layers = self.config.layers.model_copy(update={"enabled": "never"})  # they are on disk
        self._slam = Slam(self.config.model_copy(update={"layers": layers}))
        self._ending = _read_ending(run, self.config.viewer.max_points)
        self._loops = _read_loops(run, self.config)
        self._records: list[ClosureRecord] = []
        self._known_times_s = None if self._ending is None else self._ending.path.times_s
        if (run / FRAMES_FILE).exists():
            self._known_times_s = load_frames(run)[0]

    def add(self, index: int, viewer: Viewer) -> None:
        """Tell of the next window, and of the loops that were closed once it was there."""
        stored = self._load(index)
        self._slam.add(stored.raw, stored.colors)
        submap = self._slam.nodes[-1].submap(stored.corrected, stored.colors)
        viewer.window(submap, stored.layers, self._times_s(stored.raw.frames))
        if self._loops is not None:
            self._close(viewer, lambda record: max(record.window_a, record.window_b) < index)

    def end(self, viewer: Viewer) -> None:
        """Tell how it ended, if it did."""
        if self._loops is not None:
            self._close(viewer, lambda _record: True)
            viewer.loops(self._loops.final(self._places()), self._loops.records)
        if self._ending is not None:
            ending = self._ending
            viewer.results(ending.cloud, ending.path, ending.path_without_loops)

    def _close(self, viewer: Viewer, is_due: Callable[[ClosureRecord], bool]) -> None:
        """Close the loops of windows that had been looked at by then."""
        assert self._loops is not None
        for record in self._loops.records[len(self._records) :]:
            if not is_due(record):
                break
            self._records.append(record)
            link = self._loops.links.get(len(self._records) - 1)
            if link is not None:
                _close_again(self._slam, link)
        viewer.loops(self._places(), self._records)

    def _places(self) -> list[Sim3]:
        return [node.world_from_window for node in self._slam.nodes]

    def _load(self, index: int) -> StoredWindow:
        if not (self._run / "layers" / f"{index:06d}.npz").exists():  # broken off in between
            raw, colors = self._files.load(index)
            return StoredWindow(raw, raw, colors, None)
        return read_window(self._files, index, self.config)

    def _times_s(self, frames: NDArray[np.int64]) -> Array:
        """Return seconds of frames; a run that was broken off early has kept none."""
        if self._known_times_s is not None and frames[-1] < len(self._known_times_s):
            return self._known_times_s[frames]
        return frames / self.config.dataset.fps


@dataclass(frozen=True)
class _Loops:
    """What a run has on disk of its loops.

    Attributes:
        records: of all candidates, in their order.
        links: closures of the pose graph, by row of ``records``.
        graph: as the run left it.
    """

    records: Sequence[ClosureRecord]
    links: dict[int, Link]
    graph: PoseGraph

    def final(self, places: Sequence[Sim3]) -> list[Sim3]:
        """Return where the run left its windows."""
        return [self.graph.places.get(i, place) for i, place in enumerate(places)]


@dataclass(frozen=True)
class _Ending:
    cloud: Cloud
    path: Trajectory
    path_without_loops: Trajectory


def _settings(run: Path) -> Config:
    if not (run / "config.yaml").exists():
        raise RunFolderError(f"no run in {run}; give a run folder, such as runs/latest")
    return load_config(None, run / "config.yaml")


def _count_windows(run: Path) -> int:
    num = 0
    while (run / "windows" / f"{num:06d}.npz").exists():
        num += 1
    if num == 0:
        raise RunFolderError(f"the run in {run} has no windows to show; run it on with --out {run}")
    return num


def _read_loops(run: Path, config: Config) -> _Loops | None:
    """Read records and pose graph; None: no loops were looked for, or the run did not end."""
    if not (run / "closures.json").exists() or not (run / "graph.g2o").exists():
        return None
    records = read_closures(run / "closures.json")
    try:
        graph = read_g2o(run / "graph.g2o", config.pose_graph)
    except DatasetError as error:
        raise RunFolderError(str(error)) from error
    links = iter(graph.links[1])
    return _Loops(records, dict(_match(records, links)), graph)


def _match(records: Sequence[ClosureRecord], links: Iterator[Link]) -> Iterator[tuple[int, Link]]:
    """Find each accepted record's link: the graph has them in the records' order."""
    for row, record in enumerate(records):
        if record.is_accepted:
            link = next(links, None)
            if link is None or {link.a, link.b} != {record.window_a, record.window_b}:
                return  # of another hand: the windows' last places tell
            yield row, link


def _close_again(slam: Slam, link: Link) -> None:
    covariance = np.asarray(np.linalg.inv(link.information), np.float64)
    sigmas = parent_sigmas(link.a_from_b, covariance)
    try:
        slam.close(link.a, link.b, link.a_from_b, sigmas)
    except DegenerateGeometryError as error:
        logger.warning("windows %d and %d are not closed again: %s", link.a, link.b, error)


def _read_ending(run: Path, most: int) -> _Ending | None:
    """Read map and paths; None: the run did not come to its end."""
    if not (run / "trajectory_tum.txt").exists():
        return None
    path = read_trajectory(run / "trajectory_tum.txt", None)
    chained = path
    if (run / CHAINED_FILE).exists():
        chained = read_trajectory(run / CHAINED_FILE, None)
    return _Ending(_read_map(run, most), path, chained)


def _read_map(run: Path, most: int) -> Cloud:
    """Read the map, or an even part of it: its tiles, or the file that old runs have."""
    if (run / "tiles" / "index.json").exists():
        return TileFiles(run / "tiles").cloud(most)
    if not (run / "map.ply").exists():
        return Cloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.float32))
    read = import_open3d().io.read_point_cloud(str(run / "map.ply"))
    points = np.asarray(read.points)
    step = max(1, -(-len(points) // most))
    colors = np.rint(np.asarray(read.colors)[::step] * 255).astype(np.uint8)
    return Cloud(points[::step], colors, np.ones(len(colors), np.float32))
