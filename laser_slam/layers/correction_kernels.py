"""Compiled loops over the pixels that layers' scales are applied to.

The inner loops run along rows, so that several pixels are done at once: where a filter remembers
what came before in a row, it is run down the columns of the transposed image.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def spread_scales(labels, log_scales, log_depth, fade, max_step):
    """Give each cell the log factor of its layer, smooth along surfaces, not across their ends.

    A recursive filter forth and back along rows and columns, twice, whose memory fades with the
    distance and with every step of log depth; unknown depth (NaN) stops it.

    Args:
        labels: (h, w) layers, from 1; 0: none.
        log_scales: (M + 1,) float32 by label.
        log_depth: (h, w) float32.
        fade: float32 memory from cell to cell of one depth; 0: no smoothing.
        max_step: float32 step of log depth that leaves a quarter of the memory.

    Returns:
        (h, w) float32; 0 where depth is NaN.
    """
    height, width = labels.shape
    values = np.empty((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            is_known = log_depth[v, u] == log_depth[v, u]  # NaN is not
            values[v, u] = log_scales[labels[v, u]] if is_known else np.float32(0.0)
    if fade > 0:
        across = np.empty((width, height), np.float32)
        _transpose(log_depth, across)
        keep_down = _memory(log_depth, fade, max_step)
        keep_across = _memory(across, fade, max_step)
        for _round in range(2):
            _transpose(values, across)
            _smooth_down(across, keep_across)
            _transpose(across, values)
            _smooth_down(values, keep_down)
    return values


@njit(cache=True, nogil=True)
def _transpose(image, out):
    for u in range(out.shape[0]):
        for v in range(out.shape[1]):
            out[u, v] = image[v, u]


@njit(cache=True, nogil=True, error_model="numpy")
def _memory(log_depth, fade, max_step):
    """Return (h, w) how much each row remembers of the one above; 0 in the first."""
    height, width = log_depth.shape
    keep = np.zeros((height, width), np.float32)
    one, end, per_step = np.float32(1.0), np.float32(4.0), np.float32(1.0) / max_step
    for v in range(1, height):
        for u in range(width):
            step = abs(log_depth[v, u] - log_depth[v - 1, u]) * per_step
            bend = one + step * step
            keep[v, u] = fade / (bend * bend) if step < end else np.float32(0.0)
    return keep


@njit(cache=True, nogil=True)
def _smooth_down(values, keep):
    height, width = values.shape
    for v in range(1, height):
        for u in range(width):
            values[v, u] += keep[v, u] * (values[v - 1, u] - values[v, u])
    for v in range(height - 2, -1, -1):
        for u in range(width):
            values[v, u] += keep[v + 1, u] * (values[v + 1, u] - values[v, u])


@njit(cache=True, nogil=True)
def add_curve(values, log_depth, start, per_unit, curve):
    """Add to (h, w) values a curve over log depth, held at its ends; nothing where that is NaN.

    Args:
        values: (h, w) float32, changed in place.
        log_depth: (h, w) float32.
        start: float32 log depth where the curve begins.
        per_unit: float32 knots of the curve per unit of log depth.
        curve: (K,) float32, evenly spaced.
    """
    last = np.float32(curve.size - 1)
    for v in range(values.shape[0]):
        for u in range(values.shape[1]):
            place = (log_depth[v, u] - start) * per_unit
            place = place if place > 0 else np.float32(0.0)
            place = place if place < last else last
            k = min(np.int32(place), np.int32(curve.size - 2))
            value = curve[k] + (place - np.float32(k)) * (curve[k + 1] - curve[k])
            values[v, u] += value if log_depth[v, u] == log_depth[v, u] else np.float32(0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def scale_depth(depth, cell_depth, cell_factor, block, out):
    """Multiply (H, W) depth by the factor of the cells around each pixel that lie at its depth.

    Args:
        depth: (H, W) float32.
        cell_depth: (h, w) float32 depth of each cell, the pixel at its upper left corner; NaN:
            unknown.
        cell_factor: (h, w) float32.
        block: how many pixels a cell has a side.
        out: (H, W) float32.
    """
    height, width = depth.shape
    near, factor = np.empty((4, width), np.float32), np.empty((4, width), np.float32)
    one, tiny, sharp = np.float32(1.0), np.float32(1e-3), np.float32(50.0)
    right = np.empty(width, np.float32)
    for u in range(width):
        right[u] = np.float32(u % block) / np.float32(block)
    for i in range(cell_depth.shape[0]):
        _corners(cell_depth, cell_factor, i, block, near, factor)
        for v in range(i * block, min((i + 1) * block, height)):
            down = np.float32(v - i * block) / np.float32(block)
            for u in range(width):
                here, beside = depth[v, u], right[u]
                per_gap = sharp / here
                g0, g1 = (near[0, u] - here) * per_gap, (near[1, u] - here) * per_gap
                g2, g3 = (near[2, u] - here) * per_gap, (near[3, u] - here) * per_gap
                w0 = ((one - down) * (one - beside) + tiny) / (one + g0 * g0)
                w1 = ((one - down) * beside + tiny) / (one + g1 * g1)
                w2 = (down * (one - beside) + tiny) / (one + g2 * g2)
                w3 = (down * beside + tiny) / (one + g3 * g3)
                weights = w0 + w1 + w2 + w3
                mean = w0 * factor[0, u] + w1 * factor[1, u] + w2 * factor[2, u] + w3 * factor[3, u]
                mean = mean / weights if weights > 0 else one
                out[v, u] = here * mean if here > 0 else here


@njit(cache=True, nogil=True)
def _corners(cell_depth, cell_factor, i, block, near, factor):
    """Fill (4, W) depth and factor of the cells around the pixels of row ``i`` of the cells.

    Unknown cells get an infinite depth: nothing is near them.
    """
    rows, columns = cell_depth.shape
    below = min(i + 1, rows - 1)
    for j in range(columns):
        beside = min(j + 1, columns - 1)
        for corner, (row, column) in enumerate(((i, j), (i, beside), (below, j), (below, beside))):
            z, f = cell_depth[row, column], cell_factor[row, column]
            if not z > 0:
                z, f = np.float32(np.inf), np.float32(1.0)
            for u in range(j * block, min((j + 1) * block, near.shape[1])):
                near[corner, u], factor[corner, u] = z, f
