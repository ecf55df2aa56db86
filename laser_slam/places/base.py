"""The contract of a place descriptor."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from laser_slam.types import Image


class Descriptor(Protocol):
    """A picture to a vector: images of one place are close, of others nearly orthogonal."""

    @property
    def size(self) -> int:
        """Return the length D of its vectors."""
        ...

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Describe one image; the same image always gives the same vector.

        Args:
            image: (H, W, 3) RGB uint8, of any size.

        Returns:
            (D,) of unit length; all zeros where there is nothing to describe.
        """
        ...
