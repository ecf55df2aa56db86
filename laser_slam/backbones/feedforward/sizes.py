"""The sizes of images that networks were trained with."""

from __future__ import annotations

from math import sqrt

PATCH_PX = 14  # both sides are whole patches
FULL = 0.8  # of the pixels: whoever has as many was resized before, and stays


def network_size(size: tuple[int, int], rule: str, limit: int) -> tuple[int, int]:
    """Return the (height, width) at which a network wants images of (height, width) ``size``.

    Reference: 'side' is VGGT's rule, which LASER feeds pi3 by as well; 'pixels' is that of pi3's
    examples. Differs: an upright image keeps its aspect, where VGGT cuts its top and bottom off;
    images that come from here are left as they are, where pi3's examples may add a column.

    Args:
        size: of the images as they are.
        rule: 'side' or 'pixels', as the settings' ``size_rule``.
        limit: the longer side, px; or the most pixels.

    >>> network_size((376, 1241), "side", 518)
    (154, 518)
    >>> network_size((376, 1241), "pixels", 255_000)
    (266, 924)
    """
    if rule == "pixels":
        return _by_pixels(size, limit)
    factor = limit / max(size)
    height, width = (max(round(side * factor / PATCH_PX), 1) * PATCH_PX for side in size)
    return height, width


def _by_pixels(size: tuple[int, int], num_pixels: int) -> tuple[int, int]:
    """Return about the aspect of ``size``, with at most so many pixels."""
    height, width = size
    is_whole = height % PATCH_PX == 0 and width % PATCH_PX == 0
    if is_whole and FULL * num_pixels <= height * width <= num_pixels:
        return size
    factor = sqrt(num_pixels / (width * height)) / PATCH_PX
    rows, columns = max(round(height * factor), 1), max(round(width * factor), 1)
    while rows * columns * PATCH_PX**2 > num_pixels and rows * columns > 1:
        is_too_wide = columns / rows > width / height
        if (is_too_wide and columns > 1) or rows == 1:
            columns -= 1
        else:
            rows -= 1
    return rows * PATCH_PX, columns * PATCH_PX
