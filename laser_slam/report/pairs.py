"""Pairs of images that may show one place, and how much all keyframes resemble each other."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from laser_slam.report.loops import ACCEPTED, REJECTED, Pairs
from laser_slam.report.style import INK, MUTED, WIDTH_PX, picture
from laser_slam.types import Image

_GAP_PX = 14
_CAPTION_PX = {1: 56, 2: 76}  # two lines, or three of half the width, by columns
_HEAD_PX = 50
_LINE = 120  # letters of a caption over the whole width
_WIDE = 1.8  # images from this ratio of the sides on get a row for each pair


@dataclass(frozen=True)
class ImagePair:
    """Two images that may show one place.

    Attributes:
        images: (H, W, 3) RGB each, the earlier visit first.
        frames: of the sequence.
        is_accepted: whether the loop was closed.
        caption: what was measured, or why not.
    """

    images: tuple[Image, Image]
    frames: tuple[int, int]
    is_accepted: bool
    caption: str


def pairs_picture(path: Path, pairs: Sequence[ImagePair], title: str) -> None:
    """Draw a contact sheet of image pairs, framed in green where closed and in red where not.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    ratio = min((image.shape[1] / image.shape[0] for p in pairs for image in p.images), default=1.0)
    columns = 1 if ratio > _WIDE else 2
    width = (WIDTH_PX - (2 * columns + 1) * _GAP_PX) // (2 * columns)
    height = round(width / ratio)
    rows = -(-len(pairs) // columns)
    row_px = height + _CAPTION_PX[columns]
    sheet_px = _HEAD_PX + max(rows, 1) * row_px
    with picture(path, sheet_px, layout=None) as figure:
        figure.text(
            _GAP_PX / WIDTH_PX,
            1 - 0.5 * _HEAD_PX / sheet_px,
            title,
            va="center",
            fontsize=11.5,
            fontweight="bold",
        )
        for i, pair in enumerate(pairs):
            left = _GAP_PX + (i % columns) * 2 * (width + _GAP_PX)
            top = _HEAD_PX + (i // columns) * row_px
            _draw_pair(figure, pair, (left, top, width, height), columns)


def similarity_picture(
    path: Path,
    similarities: NDArray[np.float32],
    frames: NDArray[np.int64],
    per_cell: int,
    accepted: Pairs,
    rejected: Pairs,
) -> None:
    """Draw how much keyframes resemble each other, closed loops in green rings.

    Args:
        path: of the PNG file.
        similarities: (C, C) cosines of keyframes, or the greatest of several; C may be 0.
        frames: (N,) rising, of the keyframes.
        per_cell: keyframes along the side of a cell.
        accepted: (A, 2) frames of the pairs that were closed.
        rejected: (R, 2) frames of the candidates that were not.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    num = len(similarities)
    with picture(path, 1060) as figure:
        axes = figure.add_subplot(title="Similarity of the keyframes' descriptors")
        axes.grid(visible=False)
        if not num:
            axes.set_axis_off()
            axes.text(0.5, 0.5, "no descriptors", ha="center", color=MUTED, fontsize=14)
            return
        image = axes.imshow(
            similarities, cmap="magma", vmin=0, vmax=_brightest(similarities), origin="lower"
        )
        bar = figure.colorbar(image, ax=axes, shrink=0.75, aspect=30, pad=0.02, extend="max")
        bar.set_label("cosine, the mean of the run removed")
        bar.outline.set_visible(False)
        _label_by_frame(axes, frames, per_cell)
        for pairs, color, label in (
            (rejected, "#9fb4c7", "rejected"),
            (accepted, "#35d07f", "closed"),
        ):
            cells = _cells(pairs, frames, per_cell)
            axes.scatter(
                cells.min(axis=1),  # the earlier visit to the right, the later one upwards
                cells.max(axis=1),
                s=46,
                facecolors="none",
                edgecolors=color,
                linewidths=1.4 if color == "#35d07f" else 0.9,
                label=f"{label} ({len(pairs)})",
                clip_on=False,
            )
        axes.set(xlim=(-0.5, num - 0.5), ylim=(-0.5, num - 0.5))
        legend = figure.legend(loc="outside lower center", ncols=2)
        legend.get_frame().set_facecolor("#55505c")
        for text in legend.get_texts():
            text.set_color("white")


def _brightest(similarities: NDArray[np.float32]) -> float:
    """Return what most revisits stay below: all that is near the diagonal would be brighter."""
    num = len(similarities)
    row, column = np.indices(similarities.shape)
    far = similarities[np.abs(row - column) > max(1, num // 20)]
    return float(np.clip(far.max(initial=0), 0.2, 1))


def _cells(pairs: Pairs, frames: NDArray[np.int64], per_cell: int) -> NDArray[np.float64]:
    rows = np.clip(np.searchsorted(frames, pairs), 0, len(frames) - 1)
    return np.asarray(rows // per_cell, np.float64).reshape(-1, 2)


def _label_by_frame(axes: Axes, frames: NDArray[np.int64], per_cell: int) -> None:
    """Put round frame numbers where their keyframes are."""
    first, last = int(frames[0]), int(frames[-1])
    round_numbers = MaxNLocator(nbins=8, integer=True).tick_values(first, max(last, first + 1))
    shown = [int(n) for n in round_numbers if first <= n <= last]
    places = np.interp(shown, frames, np.arange(len(frames))) / per_cell
    texts = [str(n) for n in shown]
    axes.set_xticks(places, texts)
    axes.set_yticks(places, texts)
    axes.set(xlabel="frame", ylabel="frame")


def _draw_pair(
    figure: Figure, pair: ImagePair, box: tuple[int, int, int, int], columns: int
) -> None:
    left, top, width, height = box
    sheet_px = figure.get_figheight() * figure.dpi
    color = ACCEPTED if pair.is_accepted else REJECTED
    for image in pair.images:
        bottom = sheet_px - top - height
        rect = (left / WIDTH_PX, bottom / sheet_px, width / WIDTH_PX, height / sheet_px)
        axes = figure.add_axes(rect, frameon=False)
        axes.imshow(image, aspect="auto", interpolation="antialiased")
        axes.set_axis_off()
        frame = Rectangle((0, 0), 1, 1, transform=axes.transAxes, fill=False, clip_on=False)
        frame.set(edgecolor=color, linewidth=2)
        axes.add_patch(frame)
        left += width + _GAP_PX
    text = f"frames {pair.frames[0]} and {pair.frames[1]}: {pair.caption}"
    lines = textwrap.wrap(text, _LINE // columns, max_lines=columns + 1, placeholder=" ...")
    x, y = box[0] / WIDTH_PX, 1 - (top + height + 5) / sheet_px
    figure.text(x, y, "\n".join(lines), va="top", fontsize=7.5, color=INK, linespacing=1.15)
