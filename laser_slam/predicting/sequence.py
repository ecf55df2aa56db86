"""A sequence of which only predictions are at hand: no images."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones import REPLAY
from laser_slam.errors import RunFolderError
from laser_slam.predicting.manifest import load_frames, load_predictions, read_identity
from laser_slam.rescoring import read_trajectory
from laser_slam.types import Frame, SequenceInfo, Trajectory


class PredictedSequence:
    """What a folder of predictions knows of the sequence that they are of.

    Args:
        folder: what ``laser-slam predict`` wrote, or the folder of a run.

    Attributes:
        identity: what tells the input from another one.
        settings: that a run needs to map just these predictions, by section.

    Raises:
        RunFolderError: it holds no predictions, not all of them, or a file is damaged.
    """

    def __init__(self, folder: Path) -> None:
        manifest = load_predictions(str(folder))
        replay = {"name": REPLAY, "replay": {"folder": str(folder)}}
        self.settings = {**manifest.settings, "backbone": replay}
        self.identity = read_identity(folder)
        self._times_s, self._unreadable = load_frames(folder)
        self._info = _describe(folder, self.identity, len(self._times_s), self._truth(folder))

    @property
    def info(self) -> SequenceInfo:
        """Say what is known of the sequence."""
        return self._info

    def frames(self) -> Generator[Frame, None, None]:
        """Give the frames' times; none has an image."""
        for index, time_s in enumerate(self._times_s):
            yield Frame(index, float(time_s), None)

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        """Return None: depth maps stay with the images."""
        return None

    def _truth(self, folder: Path) -> Trajectory | None:
        path = folder / "truth_tum.txt"
        return read_trajectory(path, self._times_s) if path.exists() else None


def _describe(
    folder: Path, identity: dict[str, Any], num_frames: int, truth: Trajectory | None
) -> SequenceInfo:
    try:
        height, width = identity["size"]
        K = identity["intrinsics"]
        return SequenceInfo(
            str(identity["name"]),
            (int(height), int(width)),
            num_frames,
            None if K is None else np.array(K, np.float64).reshape(3, 3),
            str(identity["intrinsics_source"]),
            truth,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RunFolderError(
            f"{folder / 'sequence.yaml'} is damaged; predict anew elsewhere"
        ) from error
