"""Compiled parts of the segmentation: the edges between neighbouring pixels, and their order."""

from __future__ import annotations

import numpy as np
from numba import njit

NUM_DIRECTIONS = 4  # right, down, down right, down left: each edge once
PIXEL_BITS, DIRECTION_SHIFT = np.uint64((1 << 30) - 1), np.uint64(30)
INFINITE_BITS = np.uint32(0x7F800000)  # of a float32; those of NaN are larger
BIN_SHIFT, NUM_BINS = np.uint32(17), 1 << 14  # of a float32's bits: 64 bins an octave
PORTION = 16_384  # edges, so that what is sorted stays in the cache
DIGIT_BITS, DIGITS = np.uint64(11), 2048  # of two rounds; the bits below are few or none


@njit(cache=True, nogil=True)
def weigh_edges(image, weights):
    """Fill (4, H, W) float32 weights: absolute differences; NaN where there is no edge."""
    height, width = image.shape
    weights[0, :, width - 1] = np.nan
    weights[1, height - 1] = np.nan
    weights[2, height - 1] = np.nan
    weights[3, height - 1] = np.nan
    weights[2, :, width - 1] = np.nan
    weights[3, :, 0] = np.nan
    for i in range(height):
        for j in range(width - 1):
            weights[0, i, j] = np.float32(abs(image[i, j + 1] - image[i, j]))
    for i in range(height - 1):
        for j in range(width):
            weights[1, i, j] = np.float32(abs(image[i + 1, j] - image[i, j]))
        for j in range(width - 1):
            weights[2, i, j] = np.float32(abs(image[i + 1, j + 1] - image[i, j]))
        for j in range(1, width):
            weights[3, i, j] = np.float32(abs(image[i + 1, j - 1] - image[i, j]))


@njit(cache=True, nogil=True)
def part_edges(weights, edges):
    """Part the edges to portions of rising weight, each unsorted.

    Args:
        weights: (4, H, W) float32, NaN: no edge.
        edges: (4 H W,) uint64, filled with weight (32 bits), direction (2) and pixel (30).

    Returns:
        (K, 2) where each portion ends, and the bits of a weight above all of its own.
    """
    bits = weights.reshape(-1).view(np.uint32)
    counts = np.zeros(NUM_BINS, np.uint32)
    for e in range(bits.size):
        counts[min(bits[e], INFINITE_BITS) >> BIN_SHIFT] += np.uint32(1)
    portions, places = np.zeros((NUM_BINS, 2), np.int64), np.zeros(NUM_BINS, np.uint32)
    portion_of_bin = np.zeros(NUM_BINS, np.uint16)
    num, inside, total = 0, 0, np.uint32(0)
    for b in range(INFINITE_BITS >> BIN_SHIFT):
        if inside > 0 and inside + counts[b] > PORTION:
            num, inside = num + 1, 0
            places[num] = total
        portion_of_bin[b] = num
        portions[num, 1] = np.int64(b + 1) << np.int64(BIN_SHIFT)
        inside += counts[b]
        total += counts[b]
    num_pixels = weights.shape[1] * weights.shape[2]
    for direction in range(NUM_DIRECTIONS):
        tag = np.uint64(direction) << DIRECTION_SHIFT
        for p in range(num_pixels):
            value = bits[direction * num_pixels + p]
            if value < INFINITE_BITS:
                portion = portion_of_bin[value >> BIN_SHIFT]
                edges[places[portion]] = (np.uint64(value) << np.uint64(32)) | tag | np.uint64(p)
                places[portion] += np.uint32(1)
    portions[: num + 1, 0] = places[: num + 1]
    return portions[: num + 1]


@njit(cache=True, nogil=True)
def sort_edges(edges, spare, least, above):
    """Sort a portion of the edges by weight, ties by direction and place.

    Args:
        edges: (E,) uint64.
        spare: at least (E,) uint64, overwritten.
        least: bits of a weight that none is below.
        above: bits of a weight that all are below.
    """
    low, high = np.zeros(DIGITS + 1, np.uint32), np.zeros(DIGITS + 1, np.uint32)
    first, mask, shift = np.uint64(least) << np.uint64(32), np.uint64(DIGITS - 1), np.uint64(32)
    while np.uint64(above - least) >> (shift - np.uint64(32)) > np.uint64(DIGITS * DIGITS):
        shift += np.uint64(1)
    for edge in edges:
        key = (edge - first) >> shift
        low[(key & mask) + np.uint64(1)] += np.uint32(1)
        high[(key >> DIGIT_BITS) + np.uint64(1)] += np.uint32(1)
    for d in range(DIGITS):
        low[d + 1] += low[d]
        high[d + 1] += high[d]
    for edge in edges:
        d = ((edge - first) >> shift) & mask
        spare[low[d]] = edge
        low[d] += np.uint32(1)
    for edge in spare[: edges.size]:
        d = ((edge - first) >> shift) >> DIGIT_BITS
        edges[high[d]] = edge
        high[d] += np.uint32(1)
    for e in range(1, edges.size):  # by the bits below: few stand wrong, and none far
        edge, place = edges[e], e
        while place > 0 and edges[place - 1] > edge:
            edges[place] = edges[place - 1]
            place -= 1
        edges[place] = edge
