"""Random draws of a window: a part that every window shares, and a part of its own."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Purpose(IntEnum):
    """What is drawn; each has its own stream."""

    SCALE = 0
    CURVE = 1
    LAYERS = 2
    FIELDS = 3
    BLOBS = 4
    POSES = 5
    PARTITION = 6


@dataclass(frozen=True)
class Draws:
    """Draws that are the same whenever and in whatever order a window is asked for.

    Attributes:
        seed: of the run.
        first_frame: of the window; it tells windows apart.
        last_frame: the same, of a window whose frames jump; 0: they follow one another. A window
            of two far places is another one than that which begins at the same frame.
        persistence: share of the variance that all windows have in common.
    """

    seed: int
    first_frame: int
    persistence: float
    last_frame: int = 0

    @property
    def common_weight(self) -> float:
        """Return the factor of what windows have in common."""
        return float(np.sqrt(self.persistence))

    @property
    def own_weight(self) -> float:
        """Return the factor of what is the window's own; both squares add up to 1."""
        return float(np.sqrt(1 - self.persistence))

    @property
    def _window(self) -> list[int]:
        return [self.seed, self.last_frame] if self.last_frame else [self.seed]

    def common(self, purpose: Purpose, frame: int = -1) -> np.random.Generator:
        """Return the generator that every window of the run has."""
        return np.random.default_rng([self.seed, purpose, 0, frame + 1])

    def own(self, purpose: Purpose, frame: int = -1) -> np.random.Generator:
        """Return the generator of this window."""
        return np.random.default_rng([*self._window, purpose, self.first_frame + 1, frame + 1])

    def normals(
        self, purpose: Purpose, shape: tuple[int, ...], frame: int = -1
    ) -> NDArray[np.float32]:
        """Draw normal numbers of variance 1, of which a share persists over windows."""
        common = self.common(purpose, frame).standard_normal(shape, np.float32)
        own = self.own(purpose, frame).standard_normal(shape, np.float32)
        return np.float32(self.common_weight) * common + np.float32(self.own_weight) * own
