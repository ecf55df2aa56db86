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


@njit(cache=True, nogil=True)
def smooth_along_surfaces(values, log_depth, reach, max_step):
    """Smooth (h, w) values in place along rows and columns, but not across steps of depth.

    A recursive filter forth and back whose memory fades with the distance (``reach``, in cells)
    and with every step of log depth (``max_step``); unknown depth (NaN) stops it.
    """
    height, width = values.shape
    fade = np.exp(-1.0 / reach)
    keep = np.empty((height, width), np.float32)
    for _round in range(2):
        for v in range(height):
            for u in range(1, width):
                keep[v, u] = _memory(log_depth[v, u - 1], log_depth[v, u], fade, max_step)
            for u in range(1, width):
                values[v, u] += keep[v, u] * (values[v, u - 1] - values[v, u])
            for u in range(width - 2, -1, -1):
                values[v, u] += keep[v, u + 1] * (values[v, u + 1] - values[v, u])
        for v in range(1, height):
            for u in range(width):
                keep[v, u] = _memory(log_depth[v - 1, u], log_depth[v, u], fade, max_step)
                values[v, u] += keep[v, u] * (values[v - 1, u] - values[v, u])
        for v in range(height - 2, -1, -1):
            for u in range(width):
                values[v, u] += keep[v + 1, u] * (values[v + 1, u] - values[v, u])


@njit(cache=True, nogil=True, inline="always")
def _memory(before, here, fade, max_step):
    step = abs(here - before) / max_step
    if not step < 4.0:
        return np.float32(0.0)
    return np.float32(fade / (1.0 + step * step) ** 2)


@njit(cache=True, nogil=True)
def scale_depth(depth, cell_depth, cell_factor, factor_of_block, out):
    """Multiply (H, W) depth by the factor of the cells around each pixel that lie at its depth.

    Args:
        depth: (H, W).
        cell_depth: (h, w) depth of each cell, the pixel at its upper left corner; NaN: unknown.
        cell_factor: (h, w).
        factor_of_block: how many pixels a cell has a side.
        out: (H, W).
    """
    height, width = depth.shape
    rows, columns = cell_depth.shape
    for v in range(height):
        i = v // factor_of_block
        down = np.float32(v - i * factor_of_block) / factor_of_block
        below = min(i + 1, rows - 1)
        for u in range(width):
            here = depth[v, u]
            if not here > 0:
                out[v, u] = here
                continue
            j = u // factor_of_block
            right = np.float32(u - j * factor_of_block) / factor_of_block
            beside = min(j + 1, columns - 1)
            total = weights = np.float32(0.0)
            for a in range(2):
                row = below if a else i
                for b in range(2):
                    column = beside if b else j
                    z = cell_depth[row, column]
                    if not z > 0:
                        continue
                    part = (down if a else 1 - down) * (right if b else 1 - right)
                    gap = (z - here) / (np.float32(0.02) * here)
                    weight = (part + np.float32(1e-3)) / (1 + gap * gap)
                    total += weight * cell_factor[row, column]
                    weights += weight
            out[v, u] = here * (total / weights if weights > 0 else np.float32(1.0))
