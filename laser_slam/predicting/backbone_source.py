"""Windows that a backbone predicts, in the order of the sequence, ahead of their use."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import FrameLog, Progress, StageClock, identify
from laser_slam.config import Config
from laser_slam.datasets.base import Dataset
from laser_slam.predicting.ahead import ahead
from laser_slam.predicting.manifest import (
    Manifest,
    load_frames,
    refuse_mixing,
    save_frames,
    settings_that_matter,
)
from laser_slam.predicting.sources import CALIBRATION, as_given, load_windows
from laser_slam.rectification import (
    Rectifier,
    load_calibration,
    reduce_images,
    save_calibration,
)
from laser_slam.store import WindowFiles, open_run_folder
from laser_slam.types import NO_DISTORTION, Calibration, Image, Prediction, Window
from laser_slam.windows import cut_windows, select_keyframes

logger = logging.getLogger(__name__)


class BackboneSource:
    """Windows that a backbone predicts while those before are used.

    One thread reads, chooses keyframes and cuts windows, one predicts, one stores: the backbone
    waits neither for the disk nor for the rest of the run.

    Attributes:
        files: of the windows.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        folder: Path,
        backbone: Backbone,
        clock: StageClock,
        on_progress: Progress,
    ) -> None:
        """Prepare; nothing is read or written yet.

        Args:
            dataset: the input.
            config: all settings.
            folder: of the run.
            backbone: the source of depth and poses.
            clock: is told what is under way.
            on_progress: called while the camera is calibrated.
        """
        self._dataset = dataset
        self._config = config
        self._folder = folder
        self.files = WindowFiles(folder)
        self._clock = clock
        self._on_progress = on_progress
        self._size = backbone.image_size(dataset.info.size)
        self._manifest = Manifest(
            config.backbone.name, backbone.identity(), self._size, settings_that_matter(config)
        )
        self._stored: list[list[int]] | None = None  # frames of all windows, if all are there
        self.backbone = backbone
        self.remembers = backbone.remembers
        self.calibration = as_given(dataset.info, self._size)
        self.rectifier = Rectifier(self.calibration, self._size)
        self.input = FrameLog()

    def open(self) -> None:
        """Make the folder, or take it up again."""
        if open_run_folder(self._folder, self._config, identify(self._dataset)):
            logger.info("resuming the run in %s", self._folder)
        stored = refuse_mixing(self._folder, self._manifest)
        if stored is not None:
            windows = stored.windows or []
            if windows and all(self.files.has(index) for index in range(len(windows))):
                self._stored = windows
        else:
            self._manifest.save(self._folder)

    def leave_to_others(self, identity: dict[str, Any]) -> None:
        """Note that others predict, whose backbone may differ from this machine's.

        Args:
            identity: what their predictions depend on beside the images.
        """
        self._manifest = replace(self._manifest, identity=identity)

    @property
    def is_complete(self) -> bool:
        """Tell whether all windows have had their files before."""
        return self._stored is not None

    def calibrate(self) -> None:
        """Learn how the camera projects, from the first keyframes; rectify images by it."""
        path = self._folder / CALIBRATION
        if path.exists():
            self.calibration = load_calibration(path)
        elif self._config.calibration.keyframes:
            given = self.calibration.intrinsics
            self.calibration = self.backbone.calibrate(self._first_windows(), given)
            save_calibration(path, self.calibration)
        self.rectifier = Rectifier(self.calibration, self._size)
        logger.info("calibration: %s", self.calibration.source)
        if self.calibration.warning:
            logger.warning("calibration: %s", self.calibration.warning)

    def windows(self) -> Generator[tuple[Prediction, Image], None, None]:
        """Predict the windows, or read what was said of them before the run was broken off."""
        if self._stored is not None:
            self.input = FrameLog(*load_frames(self._folder))
            yield from load_windows(self.files, self._stored, self._clock)
            return
        frames = []
        with closing(ahead(self._stored_ones(), self._clock.idle)) as stored:
            for prediction, colors in stored:
                frames.append(prediction.frames.tolist())
                yield prediction, colors
        self.finish(frames)

    def finish(self, frames: list[list[int]]) -> None:
        """Note that all windows have their files.

        Args:
            frames: indices of each window, in order.
        """
        save_frames(self._folder, self.input.times_s, self.input.unreadable)
        self._manifest.with_windows(frames).save(self._folder)

    def _stored_ones(self) -> Generator[tuple[Prediction, Image], None, None]:
        with closing(ahead(self._predicted(), self._clock.idle)) as predicted:
            for window, prediction in predicted:
                yield self._store(window, prediction)

    def _predicted(self) -> Generator[tuple[Window, Prediction | None], None, None]:
        """Give windows with what the backbone says of them; None: there is a file of it."""
        with closing(ahead(self.cut(), self._clock.idle)) as windows:
            for window in windows:
                is_there = not self.remembers and self.files.has(window.index)
                yield window, None if is_there else self._predict(window)

    def _predict(self, window: Window) -> Prediction:
        with self._clock.stage("predict"):
            return self.backbone.predict(window.images, window.frames, self.rectifier.intrinsics)

    def _store(self, window: Window, prediction: Prediction | None) -> tuple[Prediction, Image]:
        """Write a window's file, or read the one that is there."""
        if prediction is None:
            with self._clock.stage("load"):
                return self.files.load(window.index, window.frames)
        with self._clock.stage("store"):
            colors = reduce_images(window.images, prediction.depth.shape[1:])
            return self.files.save(window.index, prediction, colors)

    def cut(self) -> Generator[Window, None, None]:
        """Read the frames, choose keyframes, cut windows: lazily, one window at a time."""
        info, config, clock = self._dataset.info, self._config.windows, self._clock
        with closing(self._dataset.frames()) as stream:
            frames = clock.timed("read", self.input.note(stream))
            keyframes = clock.timed(
                "keyframes", select_keyframes(frames, config, info.intrinsics, info.size)
            )
            yield from clock.timed("windows", cut_windows(keyframes, config, self.rectifier.image))

    def _first_windows(self) -> Iterator[Window]:
        """Cut windows from the first keyframes, as the camera sees them."""
        info, config = self._dataset.info, self._config.windows
        with closing(self._dataset.frames()) as frames:
            keyframes = select_keyframes(frames, config, info.intrinsics, info.size)
            first = islice(keyframes, self._config.calibration.keyframes)
            as_seen = Calibration(None, NO_DISTORTION, self._size, "")
            for window in cut_windows(first, config, Rectifier(as_seen, self._size).image):
                yield window
                self._on_progress("calibrating", int(window.frames[-1]) + 1, None)
