"""Depth layers, their scales, and how well neighbouring windows agree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from laser_slam.report.depths import paint
from laser_slam.report.sheet import contact_sheet
from laser_slam.report.style import ACCENT, SECOND, picture
from laser_slam.types import Image

_REACH = 0.223  # log factor at the ends of the colours: 0.8 and 1.25
_TITLES = ("image", "layers", "scale (blue 0.8, red 1.25)")


def layers_picture(
    path: Path,
    images: Sequence[Image],
    labels: Sequence[NDArray[np.uint16]],
    factors: Sequence[NDArray[np.float32]],
) -> None:
    """Draw a contact sheet: a row per frame, with image, layers and what depth was multiplied by.

    Args:
        path: of the PNG file.
        images: (H, W, 3) RGB of a few frames.
        labels: (h, w) of the same frames; 0: unknown depth.
        factors: (H, W) of the same frames; NaN: unknown depth.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    rows = [
        (image, _colored(label), _scales(factor))
        for image, label, factor in zip(images, labels, factors, strict=True)
    ]
    contact_sheet(path, rows, _TITLES)


def mismatch_picture(
    path: Path, windows: Sequence[int], before: Sequence[float], after: Sequence[float]
) -> None:
    """Draw how far the depths of neighbouring windows are apart where they share frames.

    Args:
        path: of the PNG file.
        windows: indices.
        before: median absolute log-ratio after registration.
        after: the same once the layers have their scales.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    with picture(path, 420) as figure:
        axes = figure.add_subplot()
        axes.plot(windows, before, color=ACCENT, marker="o", ms=3, label="after registration")
        axes.plot(windows, after, color=SECOND, marker="o", ms=3, label="with layer scales")
        axes.set_title("Depth of shared frames: difference to the window before (first pass)")
        axes.set_xlabel("window")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=1))
        axes.legend()


def _colored(labels: NDArray[np.uint16]) -> Image:
    """Give each layer a colour unlike its neighbours'."""
    level = (labels * 0.618034) % 1.0  # the golden ratio keeps successive numbers apart
    return paint(np.where(labels > 0, level, np.nan), "hsv")


def _scales(factors: NDArray[np.float32]) -> Image:
    with np.errstate(divide="ignore", invalid="ignore"):
        level = 0.5 + 0.5 * np.clip(np.log(factors) / _REACH, -1, 1)
    return paint(level, "RdBu_r")
