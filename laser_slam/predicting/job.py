"""Predict the windows of a sequence, and nothing else."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from laser_slam.backbones import FROM_TRUTH, REPLAY, make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import Progress, StageClock, no_progress, run_log
from laser_slam.config import Config
from laser_slam.datasets.base import Dataset
from laser_slam.errors import ConfigError
from laser_slam.export import write_tum
from laser_slam.predicting.backbone_source import BackboneSource
from laser_slam.predicting.cluster import Fleet
from laser_slam.predicting.fleet import STRETCH, Crew, spread
from laser_slam.predicting.settling import settle
from laser_slam.store import link_latest, new_run_folder


class Job:
    """What a machine with the right hardware does; the folder it leaves can be mapped anywhere.

    Attributes:
        folder: of the predictions: a run that has not been mapped.
        source: of the windows.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        out: Path | None = None,
        *,
        backbone: Backbone | None = None,
        fleet: Fleet | None = None,
        on_progress: Progress = no_progress,
    ) -> None:
        """Prepare; nothing is read or written yet.

        Args:
            dataset: the input.
            config: all settings; those of windows, calibration and backbone matter.
            out: the folder, new or of a job that was broken off, which is then gone on with;
                None: ``runs/<sequence>-<time>``, with ``runs/latest`` linking to it.
            backbone: the source of depth and poses; None: the one that the settings name.
            fleet: workers that predict instead of this process; None: there are none.
            on_progress: called with a stage's name, how much is done and of how much.

        Raises:
            LaserSlamError: the settings ask for what cannot predict.
        """
        if backbone is None and config.backbone.name == REPLAY:
            raise ConfigError("backbone.name: 'replay' predicts nothing; name a backbone")
        if fleet is not None and config.backbone.name in FROM_TRUTH:
            raise ConfigError(
                f"--engine: '{config.backbone.name}' knows the truth of the data set, which "
                "workers do not have; predict without --engine"
            )
        self._dataset = dataset
        self._fleet = fleet
        self._is_named_here = out is None
        self._on_progress = on_progress
        info = dataset.info
        config = settle(config, info, out)
        self.folder = Path(os.path.normpath(out)) if out else new_run_folder(info.name)
        backbone = backbone or make_backbone(config.backbone, info, dataset.true_depth)
        self._backbone = config.backbone
        clock = StageClock()
        self.source = BackboneSource(dataset, config, self.folder, backbone, clock, on_progress)
        if fleet is not None and backbone.remembers:
            self.source.start_afresh_after(STRETCH)

    def run(self) -> int:
        """Predict and store; return how many windows there are.

        Raises:
            LaserSlamError: the input, the settings or the folder cannot be used.
        """
        info = self._dataset.info
        self.source.open()
        with run_log(self.folder / "run.log"):
            self.source.calibrate()
            num = 0
            for frame in self._predict():
                num += 1
                self._on_progress("predicting", frame + 1, info.num_frames)
        if info.truth is not None:
            write_tum(self.folder / "truth_tum.txt", info.truth)
        if self._is_named_here:
            link_latest(self.folder)
        return num

    def _predict(self) -> Iterator[int]:
        """Predict here, or let the fleet do it; give the last frame of each window that is done."""
        if self._fleet is None or self.source.is_complete:
            for prediction, _ in self.source.windows():
                yield int(prediction.frames[-1])
            return
        with Crew(self._fleet, self._backbone, self.source.backbone.identity()) as crew:
            self._on_progress("predicting", 0, self._dataset.info.num_frames)  # all are ready
            for stretch in spread(self.source, crew):
                yield from (int(window.frames[-1]) for window in stretch)
