"""Contact sheets of images and what is known of them pixel by pixel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from laser_slam.report.sheet import contact_sheet
from laser_slam.types import Image

_UNKNOWN = "#32373d"
_TITLES = ("image", "inverse depth (grey: unknown)", "confidence")


def depth_picture(
    path: Path,
    images: Sequence[Image],
    depths: Sequence[NDArray[np.float32]],
    confidences: Sequence[NDArray[np.float32]],
) -> None:
    """Draw a contact sheet: a row per frame, with image, inverse depth and confidence.

    Inverse depth has one colour scale for the whole sheet, so that frames can be compared.

    Args:
        path: of the PNG file.
        images: (H, W, 3) RGB of a few frames.
        depths: (H, W) of the same frames, in one unit; NaN: unknown.
        confidences: (H, W) in [0, 1].

    Raises:
        RunFolderError: the picture cannot be written.
    """
    panels = [(image, *_colored(depths, confidences, i)) for i, image in enumerate(images)]
    contact_sheet(path, panels, _TITLES)


def _colored(
    depths: Sequence[NDArray[np.float32]], confidences: Sequence[NDArray[np.float32]], i: int
) -> tuple[Image, Image]:
    """Return the (H, W, 3) colours of one frame's inverse depth and confidence."""
    low, high = _inverse_range(depths)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depths[i] > 0, 1 / depths[i], np.nan)
    level = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)
    return paint(level, "turbo"), paint(confidences[i], "viridis")


def _inverse_range(depths: Sequence[NDArray[np.float32]]) -> tuple[float, float]:
    known: NDArray[Any] = np.concatenate([np.zeros(0), *(depth[depth > 0] for depth in depths)])
    if not known.size:
        return 0.0, 1.0
    far, near = np.percentile(1 / known, [2, 98])
    return float(far), float(near)


def paint(level: NDArray[Any], colors: str) -> Image:
    """Return the (H, W, 3) colours of (H, W) levels in [0, 1]; grey: not a number."""
    palette = matplotlib.colormaps[colors].with_extremes(bad=_UNKNOWN)
    return np.asarray(palette(np.ma.masked_invalid(level), bytes=True)[..., :3])
