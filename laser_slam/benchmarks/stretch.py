"""Some frames of a data set, as a data set of its own."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.base import Dataset
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo, Trajectory


class Stretch:
    """Every so many-th frame from a first one to before an end; they count from 0 here.

    Args:
        dataset: the whole; it says how many frames it has.
        first: frame of the whole that is 0 here.
        end: frame of the whole before which it ends; None: at the end.
        step: frames of the whole from one to the next.

    Raises:
        DatasetError: no frame is left, or the whole does not say how many it has.
    """

    def __init__(self, dataset: Dataset, first: int, end: int | None, step: int) -> None:
        whole = dataset.info
        if whole.num_frames is None:
            raise DatasetError(f"{whole.name} does not say how many frames it has")
        self._dataset = dataset
        self._chosen = range(whole.num_frames)[first:end:step]
        if not self._chosen:
            raise DatasetError(f"{whole.name} has {whole.num_frames} frames, none from {first} on")
        files = whole.files
        if len(files) == whole.num_frames:
            files = tuple(files[frame] for frame in self._chosen)
        self._info = replace(
            whole, num_frames=len(self._chosen), truth=self._truth(whole.truth), files=files
        )

    @property
    def info(self) -> SequenceInfo:
        """Say what is known of the chosen frames."""
        return self._info

    def frames(self) -> Generator[Frame, None, None]:
        """Read the chosen frames in order; those after the last are not read."""
        with closing(self._dataset.frames()) as frames:
            for frame in frames:
                if frame.index > self._chosen[-1]:
                    return
                if frame.index in self._chosen:
                    yield replace(frame, index=self._chosen.index(frame.index))

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        """Return the (H, W) true depth z in metres of a chosen frame, or None."""
        return self._dataset.true_depth(self._chosen[frame])

    def _truth(self, whole: Trajectory | None) -> Trajectory | None:
        if whole is None:
            return None
        rows = [row for row, frame in enumerate(whole.frames) if int(frame) in self._chosen]
        frames = np.array([self._chosen.index(int(whole.frames[row])) for row in rows], np.int64)
        return Trajectory(frames, whole.times_s[rows], whole.world_from_cam[rows])
