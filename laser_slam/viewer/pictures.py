"""Images, depth, confidence and layers as a recording keeps them: small."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import LaserSlamError
from laser_slam.types import Image

DEPTH_STEPS = 128  # of a PNG's depth in a median depth: fine enough to look at, small on disk
NUM_SCALES = 41  # colours of layer scales
BORDER = 255  # between layers
_REACH = 0.223  # log factor at the ends of the colours: 0.8 and 1.25


def encode_image(image: Image, width: int, quality: int) -> bytes:
    """Reduce a (H, W, 3) RGB or (H, W) grey image to a width and pack it as JPEG."""
    small = _resize(image, width, cv2.INTER_AREA)
    if small.ndim == 3:
        small = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    return _pack(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_depth(depth: NDArray[np.float32], width: int, unit: float) -> bytes:
    """Reduce a (H, W) depth map to a width and pack it as 16-bit PNG; 0: unknown.

    Args:
        depth: in any unit of length; not positive or not finite: unknown.
        width: in pixels.
        unit: the length that becomes ``DEPTH_STEPS``.
    """
    small = _resize(depth, width, cv2.INTER_NEAREST)
    steps = np.where(small > 0, small, 0) * (DEPTH_STEPS / unit)
    steps = np.clip(np.nan_to_num(np.rint(steps), posinf=0), 0, np.iinfo(np.uint16).max)
    return _pack(".png", steps.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 6])


def layer_classes(
    labels: NDArray[np.uint16], scales: NDArray[np.float64], width: int
) -> NDArray[np.uint8]:
    """Turn the layers of a frame into classes: 0 unknown, 1 to NUM_SCALES by scale, BORDER.

    Args:
        labels: (h, w) layer of each pixel, from 1; 0: unknown.
        scales: (M,) factor of each layer of the frame, by label - 1.
        width: to which wider ones are reduced, in pixels.
    """
    if width < labels.shape[1]:
        labels = _resize(labels, width, cv2.INTER_NEAREST)
    level = np.clip(np.log(scales) / _REACH, -1, 1)
    classes = 1 + np.rint((level + 1) / 2 * (NUM_SCALES - 1)).astype(np.uint8)
    out = np.concatenate([np.zeros(1, np.uint8), classes])[labels]
    out[:, 1:][labels[:, 1:] != labels[:, :-1]] = BORDER
    out[1:][labels[1:] != labels[:-1]] = BORDER
    return out


def class_colors() -> list[tuple[int, str, tuple[int, int, int]]]:
    """Return number, name and RGB colour of the classes: blue shrinks, grey keeps, red grows."""
    out = [(0, "unknown", (0, 0, 0)), (BORDER, "border", (20, 20, 20))]
    for i, level in enumerate(np.linspace(-1, 1, NUM_SCALES)):
        end = np.array([59, 117, 233] if level < 0 else [233, 66, 46])
        color = (1 - abs(level)) * np.array([205, 205, 205]) + abs(level) * end
        red, green, blue = (round(float(value)) for value in color)
        out.append((1 + i, f"x {np.exp(level * _REACH):.3f}", (red, green, blue)))
    return out


def _resize(image: NDArray[Any], width: int, interpolation: int) -> NDArray[Any]:
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation))


def _pack(kind: str, image: NDArray[Any], options: list[int]) -> bytes:
    is_packed, data = cv2.imencode(kind, image, options)
    if not is_packed:
        raise LaserSlamError(f"OpenCV cannot pack a {image.shape} image as {kind}")
    return bytes(data)
