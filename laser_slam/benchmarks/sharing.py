"""Windows that are predicted once, for all rows that would predict the same."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import Progress
from laser_slam.config import Config, ReplayConfig
from laser_slam.datasets.base import Dataset
from laser_slam.predicting import Job
from laser_slam.predicting.manifest import SECTIONS, settings_that_matter

FOLDER = "predictions"


def shared_folder(config: Config, out: Path, sequence: str) -> Path:
    """Return where the windows lie of all rows that would predict what ``config`` does.

    Args:
        config: of a row.
        out: of the table.
        sequence: its name in the table.
    """
    chosen = getattr(config.backbone, config.backbone.name, None)
    matters = {
        **settings_that_matter(config),
        "backbone": config.backbone.name,
        "chosen": None if chosen is None else chosen.model_dump(mode="json"),
        "synthetic": config.synthetic.model_dump(mode="json"),
    }
    text = json.dumps(matters, sort_keys=True)
    return out / FOLDER / f"{sequence}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def predict_once(
    dataset: Dataset,
    config: Config,
    folder: Path,
    backbone: Backbone | None,
    on_progress: Progress,
) -> None:
    """Predict the windows of a row into ``folder``, or what is missing of them.

    Args:
        dataset: the input.
        config: of the row.
        folder: of the predictions.
        backbone: that predicts; None: one is made as the settings say.
        on_progress: called with a stage's name, how much is done and of how much.

    Raises:
        LaserSlamError: the input, the settings or the folder cannot be used.
    """
    matters = {name: getattr(config, name) for name in (*SECTIONS, "backbone", "synthetic")}
    settings = Config(**matters)
    Job(dataset, settings, folder, backbone=backbone, on_progress=on_progress).run()


def replayed(config: Config, folder: Path) -> Config:
    """Return the settings of a row that takes its windows from ``folder``."""
    replay = ReplayConfig(folder=str(folder))
    backbone = config.backbone.model_copy(update={"name": "replay", "replay": replay})
    return config.model_copy(update={"backbone": backbone})
