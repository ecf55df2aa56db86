"""What is published of a camera: intrinsics, and a lens distortion that can be taken out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import resize_intrinsics
from laser_slam.datasets.intrinsics import check_intrinsics
from laser_slam.errors import DatasetError
from laser_slam.types import Image

Array = NDArray[np.float64]
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class Lens:
    """Published intrinsics.

    Attributes:
        intrinsics: (3, 3) in pixels of images of ``size``; None: unknown.
        source: where they come from, or why they are unknown, in words.
        size: (height, width) that they are for; None: that of the sequence's images.
        distortion: (5,) k1, k2, p1, p2, k3 as OpenCV defines them; None: the images have none, or
            it is unknown.
    """

    intrinsics: Array | None
    source: str
    size: tuple[int, int] | None = None
    distortion: Array | None = None

    def at(self, size: tuple[int, int]) -> Array | None:
        """Return the (3, 3) intrinsics of images of (height, width) ``size``.

        Raises:
            DatasetError: no image of that size can have them.
        """
        if self.intrinsics is None:
            return None
        scaled = resize_intrinsics(self.intrinsics, self.size or size, size)
        return check_intrinsics(scaled, size, self.source)


class Undistortion:
    """Images and depth as a pinhole camera would have taken them, at their own size.

    It is a little narrower than the lens, so that no pixel looks beyond the image's border.

    Args:
        lens: with intrinsics.
        size: (height, width) of the images.

    Attributes:
        intrinsics: (3, 3) of the pinhole camera.

    Raises:
        DatasetError: the lens is unknown.
    """

    def __init__(self, lens: Lens, size: tuple[int, int]) -> None:
        bent = lens.at(size)
        if bent is None:
            raise DatasetError(f"--rectify needs the lens, which is {lens.source}")
        self._map: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self.intrinsics = bent
        if lens.distortion is None:
            return
        pixels = size[::-1]
        K, _ = cv2.getOptimalNewCameraMatrix(bent, lens.distortion, pixels, 0)
        self.intrinsics = np.asarray(K, np.float64)
        maps = cv2.initUndistortRectifyMap(
            bent, lens.distortion, np.eye(3), self.intrinsics, pixels, cv2.CV_32FC1
        )
        self._map = np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)

    @property
    def bends(self) -> bool:
        """Tell whether there is a distortion to take out."""
        return self._map is not None

    def image(self, image: Image) -> Image:
        """Straighten an (H, W, 3) image."""
        if self._map is None:
            return image
        return np.asarray(cv2.remap(image, *self._map, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE))

    def depth(self, depth: Depth) -> Depth:
        """Straighten (H, W) depth z by its nearest pixels; NaN stays NaN."""
        if self._map is None:
            return depth
        options = (cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, np.nan)
        return np.asarray(cv2.remap(depth, *self._map, *options))
