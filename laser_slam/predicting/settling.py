"""Settings that the run itself has to decide."""

from __future__ import annotations

from pathlib import Path

from laser_slam.backbones import REPLAY, choose_window_size
from laser_slam.config import Config, load_config
from laser_slam.predicting.manifest import load_predictions
from laser_slam.types import SequenceInfo


def settle(config: Config, info: SequenceInfo, folder: Path | None) -> Config:
    """Put what is decided now in the place of what was left open.

    Args:
        config: all settings.
        info: of the data set.
        folder: of the run; one that was broken off has decided before. None: a new one.

    Raises:
        LaserSlamError: predictions are to be replayed, and they are not there.
    """
    if config.backbone.name == REPLAY:
        return _with_origin(config)
    if config.windows.size:
        return config
    stored = None if folder is None else folder / "config.yaml"
    if stored is not None and stored.exists():
        size = load_config(None, stored).windows.size
    else:
        size = choose_window_size(config.backbone, info.size, config.windows.overlap)
    windows = config.windows.model_copy(update={"size": size})
    return config.model_copy(update={"windows": windows})


def _with_origin(config: Config) -> Config:
    manifest = load_predictions(config.backbone.replay.folder)
    if not config.windows.size:
        size = manifest.settings["windows"]["size"]
        windows = config.windows.model_copy(update={"size": size})
        config = config.model_copy(update={"windows": windows})
    replay = config.backbone.replay.model_copy(update={"made_by": manifest.backbone})
    backbone = config.backbone.model_copy(update={"replay": replay})
    return config.model_copy(update={"backbone": backbone})
