"""Images as a pinhole camera would have taken them, at the size that the backbone wants."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image as Pillow

from laser_slam.camera import distort, resize_intrinsics
from laser_slam.errors import DegenerateGeometryError, RunFolderError
from laser_slam.store import write_text
from laser_slam.types import Calibration, Image

Array = NDArray[np.float64]

BISECTIONS = 30
MAX_ZOOM = 3.0
HALF_PX = 0.49  # of a pixel around its centre, so that its nearest pixel lies inside too
NEGLIGIBLE_PX = 0.02  # distortion below it is not worth a resampling


class Rectifier:
    """Resize images and take out the lens distortion.

    Attributes:
        intrinsics: (3, 3) pinhole intrinsics in pixels of the images that come out; None: unknown.
    """

    def __init__(self, calibration: Calibration, size: tuple[int, int]) -> None:
        """Prepare the maps.

        Args:
            calibration: of the camera, at any size.
            size: (height, width) of the images that come out.

        Raises:
            DegenerateGeometryError: the distortion is stronger than a lens can have.
        """
        self._size = size
        self._map: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self.intrinsics: Array | None = None
        if calibration.intrinsics is None:
            return
        lens = resize_intrinsics(calibration.intrinsics, calibration.size, size)
        self.intrinsics = lens.copy()
        if _largest_shift_px(lens, calibration.distortion, size) < NEGLIGIBLE_PX:
            return
        zoom = _zoom(lens, calibration.distortion, size)
        self.intrinsics[0, 0] *= zoom
        self.intrinsics[1, 1] *= zoom
        pixels = _source_pixels(lens, self.intrinsics, calibration.distortion, _grid(size))
        self._map = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)

    @property
    def bends(self) -> bool:
        """Tell whether there is a distortion to take out."""
        return self._map is not None

    def image(self, image: Image) -> Image:
        """Rectify an (H, W, 3) image of any size of the calibrated shape."""
        image = resize_image(image, self._size)
        if self._map is None:
            return image
        return np.asarray(cv2.remap(image, *self._map, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE))

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Rectify an (H, W) depth map by its nearest pixels; NaN stays NaN."""
        # INTER_NEAREST would take each block's corner, half a block off
        small = cv2.resize(depth, self._size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        if self._map is None:
            return np.asarray(small)
        options = (cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, np.nan)
        return np.asarray(cv2.remap(small, *self._map, *options))


def resize_image(image: Image, size: tuple[int, int]) -> Image:
    """Return (height, width, 3) of an RGB image: bicubic over all pixels that a new one covers.

    To the grey level what Pillow makes of it, for that is what networks were fed with.
    """
    if image.shape[:2] == size:
        return image
    resized = Pillow.fromarray(image).resize(size[::-1], Pillow.Resampling.BICUBIC)
    return np.array(resized)


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write a camera's calibration as YAML.

    Raises:
        RunFolderError: the file cannot be written.
    """
    K = calibration.intrinsics
    content = {
        "size": list(calibration.size),
        "intrinsics": None if K is None else K.tolist(),
        "distortion": calibration.distortion.tolist(),
        "source": calibration.source,
    }
    write_text(path, yaml.safe_dump(content, sort_keys=False))


def load_calibration(path: Path) -> Calibration:
    """Read a camera's calibration.

    Raises:
        RunFolderError: the file is missing or holds something else.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        K = content["intrinsics"]
        height, width = content["size"]
        calibration = Calibration(
            None if K is None else np.array(K, np.float64).reshape(3, 3),
            np.array(content["distortion"], np.float64).reshape(4),
            (int(height), int(width)),
            str(content["source"]),
        )
        _check(calibration)
    except (OSError, yaml.YAMLError, TypeError, KeyError, ValueError) as error:
        raise RunFolderError(f"{path} is no calibration: remove it to calibrate again") from error
    return calibration


def _check(calibration: Calibration) -> None:
    """Refuse numbers that no camera has."""
    K = calibration.intrinsics
    if min(calibration.size) < 1 or not np.isfinite(calibration.distortion).all():
        raise ValueError("size and distortion")
    if K is not None and not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError("intrinsics")


def _grid(size: tuple[int, int]) -> Array:
    """Return (H, W, 2) pixels x, y."""
    return np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), axis=-1).astype(np.float64)


def _border(size: tuple[int, int]) -> Array:
    grid = _grid(size)
    return np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])


def _source_pixels(lens: Array, pinhole: Array, distortion: Array, pixels: Array) -> Array:
    """Return where in the distorted image (..., 2) pixels of the pinhole image are."""
    focal, centre = pinhole[[0, 1], [0, 1]], pinhole[:2, 2]
    rays = distort((pixels - centre) / focal, distortion)
    return np.asarray(rays * lens[[0, 1], [0, 1]] + lens[:2, 2])


def _largest_shift_px(lens: Array, distortion: Array, size: tuple[int, int]) -> float:
    border = _border(size)
    return float(np.abs(_source_pixels(lens, lens, distortion, border) - border).max())


def _zoom(lens: Array, distortion: Array, size: tuple[int, int]) -> float:
    """Find the smallest zoom >= 1 at which no pixel lies outside the distorted image."""
    border, limits = _border(size), np.array([size[1] - 1, size[0] - 1])

    def fits(zoom: float) -> bool:
        pinhole = lens.copy()
        pinhole[0, 0] *= zoom
        pinhole[1, 1] *= zoom
        source = _source_pixels(lens, pinhole, distortion, border)
        return bool(np.all((source > -HALF_PX) & (source < limits + HALF_PX)))

    low, high = 1.0, MAX_ZOOM
    if fits(low):
        return low
    if not fits(high):
        k1, k2 = distortion[:2]
        raise DegenerateGeometryError(
            f"no lens has the distortion k1 = {k1:.3g}, k2 = {k2:.3g}: correct the calibration"
        )
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def reduce_images(images: tuple[Image, ...], size: tuple[int, ...]) -> Image:
    """Reduce images to (height, width) ``size``, such as that of depth maps; (N, h, w, 3) RGB."""
    height, width = size
    return np.stack(
        [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in images]
    )
