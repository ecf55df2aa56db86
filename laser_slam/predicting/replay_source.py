"""Windows that were predicted before, read back from their files."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import closing
from pathlib import Path

from laser_slam.bookkeeping import FrameLog, StageClock, identify
from laser_slam.config import Config
from laser_slam.datasets.base import Dataset
from laser_slam.errors import RunFolderError
from laser_slam.predicting.manifest import (
    load_frames,
    load_predictions,
    read_identity,
    refuse_mixing,
    refuse_others,
    save_frames,
    settings_that_matter,
)
from laser_slam.predicting.sequence import PredictedSequence
from laser_slam.predicting.sources import CALIBRATION, as_given, load_windows
from laser_slam.rectification import Rectifier, load_calibration, save_calibration
from laser_slam.store import WindowFiles, open_run_folder
from laser_slam.types import Image, Prediction

logger = logging.getLogger(__name__)


class ReplaySource:
    """Windows that were predicted before, perhaps elsewhere; no image is looked at."""

    backbone = None
    remembers = False

    def __init__(self, dataset: Dataset, config: Config, folder: Path, clock: StageClock) -> None:
        """Prepare; nothing is written yet.

        Args:
            dataset: the input that was predicted.
            config: all settings; ``backbone.replay.folder`` holds the predictions.
            folder: of the run.
            clock: is told what is under way.

        Raises:
            LaserSlamError: there are no predictions, not all of them, or those of other windows.
        """
        self._dataset = dataset
        self._config = config
        self._folder = folder
        self._files = WindowFiles(folder)
        self._clock = clock
        self._origin = Path(config.backbone.replay.folder)
        self._manifest = load_predictions(config.backbone.replay.folder)
        refuse_others(
            self._origin, self._manifest.settings, settings_that_matter(config), "settings"
        )
        size = self._manifest.image_size
        path = self._origin / CALIBRATION
        self.calibration = load_calibration(path) if path.exists() else as_given(dataset.info, size)
        self.rectifier = Rectifier(self.calibration, size)
        self.input = FrameLog(*load_frames(self._origin))

    def open(self) -> None:
        """Make the folder, or take it up again; refuse predictions of another input."""
        if self._folder.resolve() == self._origin.resolve():
            raise RunFolderError(
                f"the predictions in {self._origin} cannot be mapped into their own folder; "
                "choose another with --out"
            )
        dataset = self._dataset
        known = dataset.identity if isinstance(dataset, PredictedSequence) else None
        sequence = known or identify(dataset)
        refuse_others(self._origin, read_identity(self._origin), sequence, "images")
        if open_run_folder(self._folder, self._config, sequence):
            logger.info("resuming the run in %s", self._folder)
        refuse_mixing(self._folder, self._manifest)

    def calibrate(self) -> None:
        """Keep the calibration with which the windows were predicted."""
        save_calibration(self._folder / CALIBRATION, self.calibration)
        self._manifest.save(self._folder)
        save_frames(self._folder, self.input.times_s, self.input.unreadable)

    def windows(self) -> Generator[tuple[Prediction, Image], None, None]:
        """Read the windows, whose files become the run's own."""
        origin = WindowFiles(self._origin)
        loaded = load_windows(origin, self._manifest.windows or [], self._clock)
        with closing(loaded) as windows:
            for index, window in enumerate(windows):
                if not self._files.has(index):
                    self._files.adopt(index, origin)
                yield window
