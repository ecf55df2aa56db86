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
def overlaps(shared, tau):
    """Return which labels' intersection over union exceeds ``tau``: (E,) each, and (E,) it.

    Args:
        shared: (M + 1, N + 1) pixels of each pair of labels; 0 is no label, and no union.
        tau: IoU.
    """
    first, second = shared[1:, 1:].sum(axis=1), shared[1:, 1:].sum(axis=0)
    rows, columns = np.nonzero(shared[1:, 1:])
    iou = np.empty(rows.size, np.float64)
    num = 0
    for e in range(rows.size):
        m, n = rows[e], columns[e]
        both = shared[m + 1, n + 1]
        share = both / (first[m] + second[n] - both)
        if share > tau:
            rows[num], columns[num], iou[num] = m, n, share
            num += 1
    return rows[:num], columns[:num], iou[:num]


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
    depth, at = np.empty(width), np.empty(width, np.int32)
    for v in range(height):
        _project_row(here[v], v, pixel_there_from_here, (height, width, block), depth, at)
        for u in range(width):
            if at[u] >= 0:
                row = at[u] // width
                column = at[u] - row * width
                if abs(there[row, column] - depth[u]) < 0.15 * depth[u]:
                    out[v, u] = labels[row, column]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _project_row(here, v, M, shape, depth, at):
    """Fill (w,) depth in the other frame and which of its cells a row's cells fall on; -1: none.

    Without branches, so that several cells are done at once.
    """
    height, width, block = shape
    a, b, c = M[:, 1] * (v * block) + M[:, 2]
    for u in range(here.size):
        z, x = np.float64(here[u]), np.float64(u * block)
        far = (M[2, 0] * x + c) * z + M[2, 3]
        per_cell = 1.0 / (far * block)
        column = ((M[0, 0] * x + a) * z + M[0, 3]) * per_cell + 0.5
        row = ((M[1, 0] * x + b) * z + M[1, 3]) * per_cell + 0.5
        inside = (z > 0) & (far > 0) & (row >= 0) & (row < height)
        inside &= (column >= 0) & (column < width)  # int() alone rounds towards zero
        row, column = row if inside else 0.0, column if inside else 0.0
        depth[u] = far
        at[u] = np.int32(row) * width + np.int32(column) if inside else -1
