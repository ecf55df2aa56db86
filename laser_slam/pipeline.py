"""A run: read, predict, register, store; then trajectory, map, scores, files."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import (
    Progress,
    StageClock,
    no_progress,
    run_log,
)
from laser_slam.camera import resize_intrinsics
from laser_slam.closures import Tools, make_matcher
from laser_slam.config import Config
from laser_slam.datasets.base import Dataset
from laser_slam.predicting import make_source, settle
from laser_slam.report import stages_picture
from laser_slam.results import (
    Findings,
    RawCloud,
    Results,
    describe_course,
    describe_layers,
    describe_loops,
    describe_sequence,
    describe_system,
    describe_windows,
    draw_findings,
    fuse_run,
    list_keyframes,
    look_back,
    place_window,
    sample_views,
    score_views,
    write_findings,
    write_report,
    write_report_page,
)
from laser_slam.sim3 import interpolate_poses
from laser_slam.slam import LoopCloser, Slam, StoredWindow, read_window
from laser_slam.store import TileFiles, WindowFiles, link_latest, new_run_folder
from laser_slam.store.keyframes import save_originals
from laser_slam.types import Image, Prediction, Trajectory
from laser_slam.viewer import NullViewer, Viewer

logger = logging.getLogger(__name__)


def no_viewer(_folder: Path, _config: Config) -> Viewer:
    """Watch nothing."""
    return NullViewer()


class Pipeline:
    """One run over a data set; everything that it leaves is in its folder.

    Memory stays flat over the run: images and predictions pass through one window at a time.

    Attributes:
        folder: of the run.
        source: of the predicted windows.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        out: Path | None = None,
        *,
        backbone: Backbone | None = None,
        on_progress: Progress = no_progress,
        make_viewer: Callable[[Path, Config], Viewer] = no_viewer,
    ) -> None:
        """Prepare a run; nothing is read or written yet.

        Args:
            dataset: the input.
            config: all settings.
            out: the run's folder, new or of a run that was broken off, which is then resumed;
                None: ``runs/<sequence>-<time>``, with ``runs/latest`` linking to it.
            backbone: the source of depth and poses; None: the one that the settings name.
            on_progress: called with a stage's name, how much is done and of how much.
            make_viewer: gives who watches the run, from its folder and settings.
        """
        self._dataset = dataset
        self._info = dataset.info
        self._config = config = settle(config, self._info, out)
        self._on_progress = on_progress
        self._clock = StageClock()
        self._slam = Slam(config, self._clock.stage)
        self._intrinsics: list[NDArray[np.float64]] = []
        self._is_named_here = out is None
        self.folder = Path(os.path.normpath(out)) if out else new_run_folder(self._info.name)
        self.source = make_source(dataset, config, self.folder, backbone, self._clock, on_progress)
        self._files = WindowFiles(self.folder)
        self._closer = self._make_closer()
        self._make_viewer = make_viewer
        self._viewer: Viewer = NullViewer()

    def run(self) -> Results:
        """Map the sequence.

        Raises:
            LaserSlamError: the input, the settings or the folder cannot be used.
        """
        self.source.open()
        self._viewer = self._make_viewer(self.folder, self._config)
        with run_log(self.folder / "run.log") as warnings, closing(self._viewer):
            with self._clock.stage("calibrate"):
                self.source.calibrate()
            with closing(self.source.windows()) as windows:
                for prediction, colors in windows:
                    self._place(prediction, colors)
            if self._closer is not None:
                with self._clock.stage("places"):
                    self._closer.finish()
            with self._clock.stage("layers"):
                self._slam.smooth_layers(self._files)
            trajectory = self._trajectory()
            tiles, raw = self._fuse()
            with self._clock.stage("evaluate"):
                found = self._evaluate(trajectory, tiles, raw)
            self._write(found)
            self._show(found)
            report = self._report(found, warnings)
            write_report(self.folder / "report.json", report)  # with it, the run is finished
        if self._is_named_here:
            link_latest(self.folder)
        write_report_page(self.folder)
        return Results(self.folder, trajectory, found.cloud, report)

    def _make_closer(self) -> LoopCloser | None:
        if not self._config.closures.enabled:
            return None
        tools = Tools(make_matcher(self._config.places.verification), self.source.backbone)
        return LoopCloser(self._config, self._slam, self._files, tools)

    def _place(self, prediction: Prediction, colors: Image) -> None:
        for warning in prediction.warnings:
            logger.warning("window %d: %s", len(self._slam.nodes), warning)
        submap = self._slam.add(prediction, colors)
        if self._slam.layers is not None:
            with self._clock.stage("store"):
                self._files.save_layers(submap.index, self._slam.layers)
        with self._clock.stage("view"):
            times_s = [self.source.input.times_s[frame] for frame in prediction.frames]
            self._viewer.window(submap, self._slam.layers, np.array(times_s))
        if self._closer is not None:
            with self._clock.stage("places"):
                self._closer.add(submap.prediction, colors)
        self._show_loops()
        size = (prediction.depth.shape[1], prediction.depth.shape[2])
        self._intrinsics.append(resize_intrinsics(prediction.intrinsics[0], size, self._info.size))
        self._on_progress("mapping", int(prediction.frames[-1]) + 1, self._info.num_frames)

    def _show_loops(self) -> None:
        """Show where windows are by now, and what became of the loop candidates."""
        with self._clock.stage("view"):
            places = [node.world_from_window for node in self._slam.nodes]
            self._viewer.loops(places, self._closer.records if self._closer else [])

    def _show(self, found: Findings) -> None:
        self._show_loops()
        with self._clock.stage("view"):
            chained = found.loops.chained if found.loops else found.trajectory
            self._viewer.results(found.cloud, found.trajectory, chained)

    def _trajectory(self, *, closed: bool = True) -> Trajectory:
        """Give every frame of the input a pose, those between keyframes by interpolation."""
        times_s = np.array(self.source.input.times_s)
        with self._clock.stage("trajectory"):
            key = self._slam.trajectory(times_s, closed=closed)
            world_from_cam = interpolate_poses(times_s, key.times_s, key.world_from_cam)
        return Trajectory(np.arange(len(times_s)), times_s, world_from_cam)

    def _fuse(self) -> tuple[TileFiles, RawCloud]:
        keyframes = list_keyframes(self._slam)
        raw = RawCloud(len(keyframes.frames))

        def load(index: int) -> StoredWindow:
            with self._clock.stage("load"):
                return self._load(index)

        def watch(done: int, num: int) -> None:
            self._on_progress("fusing", done, num)

        with self._clock.stage("fuse"):
            tiles = fuse_run(self.folder, keyframes, self._config, load, watch, raw.add)
            for node in self._slam.nodes:
                if not raw.has(node.index):  # nothing in its part of the map had to be made
                    raw.add(place_window(keyframes, node.index, load(node.index)))
        if not tiles.num_points:
            logger.warning("the map is empty: nothing was seen with confidence")
        return tiles, raw

    def _evaluate(self, trajectory: Trajectory, tiles: TileFiles, raw: RawCloud) -> Findings:
        """Compare with the truth, as far as there is one, and with the run without its loops."""
        truth, config = self._info.truth, self._config
        views = list(sample_views(self._slam.nodes, self._load, config.run.samples))
        least = config.fusion.min_confidence
        scores = score_views(views, trajectory, truth, self._true_depth, least)
        loops = None
        if self._closer is not None:
            loops = look_back(self._closer, self._slam, self._trajectory(closed=False), truth)
        unfiltered = raw.cloud(tiles.voxel_size)
        cloud = tiles.cloud(config.fusion.cloud_points)
        return Findings(trajectory, cloud, scores, loops, truth, tiles, unfiltered)

    def _true_depth(self, frame: int) -> NDArray[np.float32] | None:
        truth = self._dataset.true_depth(frame)
        return None if truth is None else self.source.rectifier.depth(truth)

    def _write(self, found: Findings) -> None:
        with self._clock.stage("write"):
            write_findings(self.folder, found, self._slam)
            save_originals(self.folder, self._info, self.source.calibration)
        with self._clock.stage("pictures"):
            draw_findings(self.folder / "pictures", found, self._slam.nodes, self._files)
        stages_picture(self.folder / "pictures" / "stages.png", dict(self._clock.wall_s))

    def _report(self, found: Findings, warnings: list[str]) -> dict[str, Any]:
        scores = found.scores
        return {
            "sequence": describe_sequence(self._info, self.source.calibration, self._intrinsics),
            "frames": {**self.source.input.counts(), "keyframes": self._slam.num_keyframes},
            "windows": describe_windows(self._slam, found),
            "paths": describe_course(found),
            "trajectory": scores.trajectory.numbers() if scores.trajectory else None,
            "depth": scores.depth,
            "depth_without_layers": scores.raw_depth,
            "layers": describe_layers(self._slam.nodes, self._files),
            "closures": describe_loops(found.loops),
            "map": {"num_points": found.num_points, "voxel_size": found.cloud.voxel_size},
            "warnings": warnings,
            **self._clock.report(len(self.source.input.times_s)),
            "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
            **describe_system(),
            "settings": self._config.model_dump(mode="json"),
        }

    def _load(self, index: int) -> StoredWindow:
        return read_window(self._files, index, self._config)
