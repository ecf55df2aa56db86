"""Predict the windows of a sequence, and nothing else."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from laser_slam.backbones import FROM_TRUTH, REPLAY, make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import Progress, StageClock, no_progress, run_log
from laser_slam.config import BackboneConfig, Config, DeviceConfig, NetworkConfig
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
        if fleet is not None:
            _refuse_what_cannot_spread(config)
        self._dataset = dataset
        self._fleet = fleet
        self._is_named_here = out is None
        self._on_progress = on_progress
        info = dataset.info
        config = settle(config, info, out)
        self.folder = Path(os.path.normpath(out)) if out else new_run_folder(info.name)
        # Of a fleet, this machine does all but predict: it may have no GPU.
        here = config.backbone if fleet is None else _on_cpu(config.backbone)
        backbone = backbone or make_backbone(here, info, dataset.true_depth)
        self._backbone = config.backbone
        clock = StageClock()
        self.source = BackboneSource(dataset, config, self.folder, backbone, clock, on_progress)

    def run(self) -> int:
        """Predict and store; return how many windows there are.

        Raises:
            LaserSlamError: the input, the settings or the folder cannot be used.
        """
        info, num = self._dataset.info, 0
        with self._crew() as crew:
            self.source.open()
            with run_log(self.folder / "run.log"):
                self.source.calibrate()
                with closing(self._predict(crew)) as last_frames:
                    for frame in last_frames:
                        num += 1
                        self._on_progress("predicting", frame + 1, info.num_frames)
        if info.truth is not None:
            write_tum(self.folder / "truth_tum.txt", info.truth)
        if self._is_named_here:
            link_latest(self.folder)
        return num

    @contextmanager
    def _crew(self) -> Iterator[Crew | None]:
        """Have the workers ready; what they predict with is what the predictions are made by."""
        if self._fleet is None:
            yield None
            return
        with Crew(self._fleet, self._backbone) as crew:
            stretch = {"stretch": STRETCH} if self.source.remembers else {}
            self.source.leave_to_others({**crew.identity, **stretch})
            yield crew

    def _predict(self, crew: Crew | None) -> Generator[int, None, None]:
        """Predict here, or let the crew do it; give the last frame of each window that is done."""
        if crew is None or self.source.is_complete:
            with closing(self.source.windows()) as windows:
                for prediction, _ in windows:
                    yield int(prediction.frames[-1])
            return
        self._on_progress("predicting", 0, self._dataset.info.num_frames)  # all are ready
        for stretch in spread(self.source, crew):
            yield from (int(window.frames[-1]) for window in stretch)


def _refuse_what_cannot_spread(config: Config) -> None:
    if config.backbone.name in FROM_TRUTH:
        raise ConfigError(
            f"--engine: '{config.backbone.name}' knows the truth of the data set, which "
            "workers do not have; predict without --engine"
        )
    if not config.windows.size:
        raise ConfigError("windows.size: auto looks at this machine; give the workers a number")


def _on_cpu(config: BackboneConfig) -> BackboneConfig:
    """Return the settings of a network for a machine that does not run it; else as they are."""
    section = getattr(config, config.name, None)
    if not isinstance(section, DeviceConfig):
        return config
    update = {"device": "cpu", **({"dtype": "auto"} if isinstance(section, NetworkConfig) else {})}
    return config.model_copy(update={config.name: section.model_copy(update=update)})
