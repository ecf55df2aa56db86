"""Rows of pictures on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from laser_slam.report.style import INK, WIDTH_PX, picture
from laser_slam.types import Image

_GAP_PX = 10
_HEAD_PX = 50


def contact_sheet(path: Path, rows: Sequence[tuple[Image, ...]], titles: tuple[str, ...]) -> None:
    """Draw rows of panels, a title above each column.

    Args:
        path: of the PNG file.
        rows: panels (H, W, 3) RGB of each row; the first one's shape is the row's.
        titles: of the columns.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    num = len(titles)
    column_px = (WIDTH_PX - (num + 1) * _GAP_PX) // num
    rows_px = [round(column_px * panels[0].shape[0] / panels[0].shape[1]) for panels in rows]
    height_px = _HEAD_PX + sum(row + _GAP_PX for row in rows_px)
    with picture(path, max(height_px, 2 * _HEAD_PX), layout=None) as figure:
        top = _HEAD_PX
        for panels, row_px in zip(rows, rows_px, strict=True):
            for column, panel in enumerate(panels):
                left = _GAP_PX + column * (column_px + _GAP_PX)
                box = (left, height_px - top - row_px, column_px, row_px)
                figure.add_axes(_relative(box, height_px), frameon=False).imshow(
                    panel, aspect="auto", interpolation="antialiased"
                )
                figure.axes[-1].set_axis_off()
            top += row_px + _GAP_PX
        for column, title in enumerate(titles):
            x = (_GAP_PX + column * (column_px + _GAP_PX)) / WIDTH_PX
            figure.text(x, 1 - 0.5 * _HEAD_PX / height_px, title, va="center", color=INK)


def _relative(
    box_px: tuple[int, int, int, int], height_px: int
) -> tuple[float, float, float, float]:
    left, bottom, width, height = box_px
    return (left / WIDTH_PX, bottom / height_px, width / WIDTH_PX, height / height_px)
