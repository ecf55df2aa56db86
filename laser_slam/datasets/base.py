"""The contract of a data set."""

from __future__ import annotations

from collections.abc import Generator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from laser_slam.types import Frame, SequenceInfo


class Dataset(Protocol):
    """An ordered sequence of images that is read as a stream, never all at once."""

    @property
    def info(self) -> SequenceInfo:
        """Say what is known before the images are read."""
        ...

    def frames(self) -> Generator[Frame, None, None]:
        """Read the frames in order; each call starts anew. Unreadable images come as None."""
        ...

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        """Return the (H, W) true depth z in metres, NaN: unknown; None: the data set has none."""
        ...
