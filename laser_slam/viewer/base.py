"""What a run tells whoever watches it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import LaserSlamError
from laser_slam.sim3 import Sim3
from laser_slam.types import Cloud, Layers, Submap, Trajectory

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


class CandidateRecord(Protocol):
    """What became of a loop candidate, as far as a viewer shows it."""

    @property
    def frame_a(self) -> int:
        """Return the frame at one end, in the sequence."""

    @property
    def frame_b(self) -> int:
        """Return the frame at the other end."""

    @property
    def verdict(self) -> str:
        """Return why it was accepted or not, in words."""

    @property
    def is_accepted(self) -> bool:
        """Tell whether it is a closure."""


class Viewer(Protocol):
    """Watch a run; a run always has a viewer and never asks which.

    Raises:
        LaserSlamError: what is shown cannot be written or sent.
    """

    def window(self, submap: Submap, layers: Layers | None, times_s: Array) -> None:
        """Show the window that was added last.

        Args:
            submap: at its place so far, its layers' scales applied.
            layers: of the window; None: they were not looked at.
            times_s: (N,) seconds of its frames.
        """

    def loops(self, places: Sequence[Sim3], records: Sequence[CandidateRecord]) -> None:
        """Show where windows are by now, and what became of the loop candidates so far.

        Args:
            places: ``world_from_window`` of all windows, by index.
            records: of all candidates, in the order in which they came.
        """

    def results(self, cloud: Cloud, path: Trajectory, path_without_loops: Trajectory) -> None:
        """Show what the run ends with.

        Args:
            cloud: the map, in world units.
            path: a pose for every frame.
            path_without_loops: the same by the registrations alone.
        """

    def close(self) -> None:
        """Show no more; what was shown stays."""


class NullViewer:
    """Show nothing, at no cost."""

    def window(self, submap: Submap, layers: Layers | None, times_s: Array) -> None:
        """Do nothing."""

    def loops(self, places: Sequence[Sim3], records: Sequence[CandidateRecord]) -> None:
        """Do nothing."""

    def results(self, cloud: Cloud, path: Trajectory, path_without_loops: Trajectory) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class BestEffortViewer:
    """Pass all on to a viewer until it fails; then warn once and show nothing more.

    A map of hours is not lost because the disk is too full for its recording.

    Args:
        viewer: that may fail.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer

    def window(self, submap: Submap, layers: Layers | None, times_s: Array) -> None:
        """Show the window that was added last."""
        self._try(lambda viewer: viewer.window(submap, layers, times_s))

    def loops(self, places: Sequence[Sim3], records: Sequence[CandidateRecord]) -> None:
        """Show where windows are by now, and what became of the loop candidates."""
        self._try(lambda viewer: viewer.loops(places, records))

    def results(self, cloud: Cloud, path: Trajectory, path_without_loops: Trajectory) -> None:
        """Show what the run ends with."""
        self._try(lambda viewer: viewer.results(cloud, path, path_without_loops))

    def close(self) -> None:
        """Show no more."""
        self._try(lambda viewer: viewer.close())

    def _try(self, show: Callable[[Viewer], None]) -> None:
        try:
            show(self._viewer)
        except LaserSlamError as error:
            logger.warning("the viewer stops here, the run goes on: %s", error)
            self._viewer = NullViewer()
