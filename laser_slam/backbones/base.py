"""The contract of a backbone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from laser_slam.types import Calibration, Image, Prediction, Window


class Backbone(Protocol):
    """A frozen model of the world: the images of one window in, geometry out."""

    @property
    def remembers(self) -> bool:
        """Tell whether a prediction depends on the windows before it, as tracks do.

        A resumed run then predicts the stored windows again, for it must end as a whole run does.
        """
        ...

    @property
    def sees_far_frames(self) -> bool:
        """Tell whether ``predict`` takes frames that do not follow one another.

        A window of two visits of a place then measures how they lie to one another.
        """
        ...

    def identity(self) -> dict[str, Any]:
        """Return what its predictions depend on beside the images, as plain YAML values.

        Such as settings that matter, size rules, the hash of a checkpoint: predictions of equal
        identity may be mixed, others not.
        """
        ...

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) at which it wants images of (height, width) ``size``."""
        ...

    def calibrate(
        self, windows: Iterable[Window], intrinsics: NDArray[np.float64] | None
    ) -> Calibration:
        """Say how the camera projects, before the run; images are then rectified by it.

        Args:
            windows: some of the sequence, at ``image_size``.
            intrinsics: (3, 3) in pixels of these images; None: unknown.
        """
        ...

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        """Predict one window.

        What it cannot do, it says in ``status`` and ``warnings``; it never raises for bad images.

        Args:
            images: N images (H, W, 3) RGB uint8 of ``image_size``.
            frames: (N,) rising indices in the sequence.
            intrinsics: (3, 3) in pixels of these images; None: unknown, to be estimated.

        Returns:
            The prediction, at a depth-map size of the backbone's choosing.
        """
        ...
