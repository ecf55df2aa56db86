"""Compiled loops over the pixels of layers."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def count_pairs(first, second, num_first, num_second):
    """Return (num_first + 1, num_second + 1) how many pixels have each pair of labels."""
    counts = np.zeros((num_first + 1, num_second + 1), np.int64)
    height, width = first.shape
    for v in range(height):
        for u in range(width):
            counts[first[v, u], second[v, u]] += 1
    return counts


@njit(cache=True, nogil=True)
def carry_labels(labels, there, here, pixel_there_from_here, block):
    """Return the (h, w) labels that another frame gives to what this frame's cells show.

    Args:
        labels: (h, w) of the other frame.
        there: (h, w) its depth.
        here: (h, w) this frame's depth; unknown depth gets label 0, as does what the other frame
            does not see: out of the image, or behind something.
        pixel_there_from_here: (3, 4) maps depth times (u, v, 1) and 1 to the other frame's depth
            times (u, v, 1); pixels.
        block: pixels that a cell has a side.
    """
    height, width = labels.shape
    out = np.zeros((height, width), labels.dtype)
    M = pixel_there_from_here
    for v in range(height):
        for u in range(width):
            z = here[v, u]
            if not z > 0:
                continue
            x, y = z * u * block, z * v * block
            depth = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
            if not depth > 0:
                continue
            column = (M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]) / depth / block + 0.5
            row = (M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]) / depth / block + 0.5
            if 0 <= row < height and 0 <= column < width:  # int() alone rounds towards zero
                if abs(there[int(row), int(column)] - depth) < 0.15 * depth:
                    out[v, u] = labels[int(row), int(column)]
    return out
