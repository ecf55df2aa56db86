"""The contact sheet of images, depth and confidence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from laser_slam.report.style import INK, WIDTH_PX, picture
from laser_slam.types import Image

_UNKNOWN = "#32373d"
_GAP_PX = 10
_HEAD_PX = 50
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
    column_px = (WIDTH_PX - 4 * _GAP_PX) // 3
    rows_px = [round(column_px * image.shape[0] / image.shape[1]) for image in images]
    height_px = _HEAD_PX + sum(row + _GAP_PX for row in rows_px)
    panels = [_colored(depths, confidences, i) for i in range(len(images))]
    with picture(path, max(height_px, 2 * _HEAD_PX), layout=None) as figure:
        top = _HEAD_PX
        for image, (depth, confidence), row_px in zip(images, panels, rows_px, strict=True):
            for column, panel in enumerate((image, depth, confidence)):
                left = _GAP_PX + column * (column_px + _GAP_PX)
                box = (left, height_px - top - row_px, column_px, row_px)
                figure.add_axes(_relative(box, height_px), frameon=False).imshow(
                    panel, aspect="auto", interpolation="antialiased"
                )
                figure.axes[-1].set_axis_off()
            top += row_px + _GAP_PX
        for column, title in enumerate(_TITLES):
            x = (_GAP_PX + column * (column_px + _GAP_PX)) / WIDTH_PX
            figure.text(x, 1 - 0.5 * _HEAD_PX / height_px, title, va="center", color=INK)


def _colored(
    depths: Sequence[NDArray[np.float32]], confidences: Sequence[NDArray[np.float32]], i: int
) -> tuple[Image, Image]:
    """Return the (H, W, 3) colours of one frame's inverse depth and confidence."""
    low, high = _inverse_range(depths)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depths[i] > 0, 1 / depths[i], np.nan)
    level = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)
    return _paint(level, "turbo"), _paint(confidences[i], "viridis")


def _inverse_range(depths: Sequence[NDArray[np.float32]]) -> tuple[float, float]:
    known: NDArray[Any] = np.concatenate([np.zeros(0), *(depth[depth > 0] for depth in depths)])
    if not known.size:
        return 0.0, 1.0
    far, near = np.percentile(1 / known, [2, 98])
    return float(far), float(near)


def _paint(level: NDArray[Any], colors: str) -> Image:
    palette = matplotlib.colormaps[colors].with_extremes(bad=_UNKNOWN)
    return np.asarray(palette(np.ma.masked_invalid(level), bytes=True)[..., :3])


def _relative(
    box_px: tuple[int, int, int, int], height_px: int
) -> tuple[float, float, float, float]:
    left, bottom, width, height = box_px
    return (left / WIDTH_PX, bottom / height_px, width / WIDTH_PX, height / height_px)
