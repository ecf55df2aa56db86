"""Which source of predicted windows the settings ask for."""

from __future__ import annotations

from pathlib import Path

from laser_slam.backbones import REPLAY, make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import Progress, StageClock
from laser_slam.config import Config
from laser_slam.datasets.base import Dataset
from laser_slam.predicting.backbone_source import BackboneSource
from laser_slam.predicting.replay_source import ReplaySource
from laser_slam.predicting.sources import Source


def make_source(
    dataset: Dataset,
    config: Config,
    folder: Path,
    backbone: Backbone | None,
    clock: StageClock,
    on_progress: Progress,
) -> Source:
    """Build the source that the settings name; nothing is read or written yet.

    Args:
        dataset: the input.
        config: all settings, settled.
        folder: of the run.
        backbone: the source of depth and poses; None: the one that the settings name.
        clock: is told what is under way.
        on_progress: called while the camera is calibrated.

    Raises:
        LaserSlamError: there is no such backbone, or it cannot be used here.
    """
    if backbone is None and config.backbone.name == REPLAY:
        return ReplaySource(dataset, config, folder, clock)
    backbone = backbone or make_backbone(config.backbone, dataset.info, dataset.true_depth)
    return BackboneSource(dataset, config, folder, backbone, clock, on_progress)
