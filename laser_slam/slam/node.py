"""A window's place in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.layers import LayerCounts
from laser_slam.pose_graph import MovedWindow
from laser_slam.sim3 import Sim3
from laser_slam.types import Image, Prediction, Registration, Submap, WindowStatus

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Node:
    """A window's place in the world: what is kept of a submap once its depth is on disk.

    Attributes:
        index: of its window.
        frames: (N,) rising indices in the sequence.
        window_from_cam: (N, 4, 4) rigid, in window units.
        chained: ``world_from_window`` by the registrations alone; world units are the units of
            the first window.
        world_from_window: the same, moved by closures.
        owned: first frame that this window owns, and the first that it no longer does.
        registration: to the window before; None for the first.
        layers: what became of its layers; None: they were not looked at.
    """

    index: int
    frames: NDArray[np.int64]
    window_from_cam: Array
    chained: Sim3
    world_from_window: Sim3
    owned: tuple[int, int]
    registration: Registration | None
    layers: LayerCounts | None = None

    @property
    def is_owned(self) -> NDArray[np.bool_]:
        """Return (N,) True where this window gives the frame to trajectory and map."""
        return (self.frames >= self.owned[0]) & (self.frames < self.owned[1])

    @property
    def measured_scale(self) -> float | None:
        """Return the scale that maps this window's unit to the last one's; None: unmeasured."""
        registration = self.registration
        if registration is None or registration.bridged:
            return None
        return registration.previous_from_current.scale

    @property
    def moved(self) -> MovedWindow:
        """Return the frames that it owns, and how far closures have moved it."""
        return MovedWindow(
            self.window_from_cam[self.is_owned], self.chained, self.world_from_window
        )

    def submap(
        self, prediction: Prediction, colors: Image, owned_places: Sequence[Sim3] = ()
    ) -> Submap:
        """Join the node with its window's prediction, from disk perhaps.

        Args:
            prediction: of the window, its layers' scales applied.
            colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.
            owned_places: ``world_from_window`` of each frame that the window owns; none: the
                window's own for all.
        """
        if prediction.status is WindowStatus.FAILED:  # its own poses mean nothing
            prediction = replace(prediction, window_from_cam=self.window_from_cam)
        return Submap(
            self.index,
            prediction,
            colors,
            self.world_from_window,
            self.is_owned,
            self.registration,
            self._places(owned_places),
        )

    def _places(self, owned_places: Sequence[Sim3]) -> tuple[Sim3, ...]:
        places = [self.world_from_window] * len(self.frames)
        for i, place in zip(np.flatnonzero(self.is_owned), owned_places, strict=False):
            places[i] = place
        return tuple(places)
