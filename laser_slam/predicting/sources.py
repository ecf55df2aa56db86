"""Where predicted windows come from: a backbone that looks at images, or files of predictions."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import Protocol

import numpy as np

from laser_slam.backbones.base import Backbone
from laser_slam.bookkeeping import FrameLog, StageClock
from laser_slam.camera import resize_intrinsics
from laser_slam.predicting.ahead import ahead
from laser_slam.rectification import Rectifier
from laser_slam.store import WindowFiles
from laser_slam.types import NO_DISTORTION, Calibration, Image, Prediction, SequenceInfo

CALIBRATION = "calibration.yaml"


class Source(Protocol):
    """Predicted windows, in order, each with a file in the run's folder.

    Attributes:
        calibration: how the camera projects.
        rectifier: of the images.
        input: what passed of the sequence; whole when the last window is there.
    """

    calibration: Calibration
    rectifier: Rectifier
    input: FrameLog

    @property
    def backbone(self) -> Backbone | None:
        """Return what can be asked about other windows; None: there is nothing."""
        ...

    @property
    def remembers(self) -> bool:
        """Tell whether a run that was broken off must see all windows again."""
        ...

    def open(self) -> None:
        """Make the folder, or take it up again; nothing else is read or written before.

        Raises:
            LaserSlamError: the folder or the input cannot be used.
        """
        ...

    def calibrate(self) -> None:
        """Learn how the camera projects."""
        ...

    def windows(self) -> Generator[tuple[Prediction, Image], None, None]:
        """Give each window with its (N, H, W, 3) RGB colours, which are in its file by then.

        Closing it ends what runs ahead.
        """
        ...


def as_given(info: SequenceInfo, size: tuple[int, int]) -> Calibration:
    """Take the camera as the data set has it, for images of (height, width) ``size``."""
    K = None if info.intrinsics is None else resize_intrinsics(info.intrinsics, info.size, size)
    return Calibration(K, NO_DISTORTION, size, info.intrinsics_source)


def load_windows(
    files: WindowFiles, windows: list[list[int]], clock: StageClock
) -> Generator[tuple[Prediction, Image], None, None]:
    """Read windows back, one ahead of their use.

    Args:
        files: that hold them.
        windows: frame indices of each.
        clock: is told what is under way.

    Raises:
        RunFolderError: a file is missing, damaged or holds other frames.
    """
    loaded = (files.load(index, np.array(frames)) for index, frames in enumerate(windows))
    with closing(ahead(clock.timed("load", loaded), clock.idle)) as windows_ahead:
        yield from windows_ahead
