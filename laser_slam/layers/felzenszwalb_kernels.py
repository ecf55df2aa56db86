"""Compiled parts of the segmentation: sorted edges, union-find, small regions.

Regions live in a forest over the pixels: ``parents[p]`` leads to the root of p's region, whose
``sizes`` counts its pixels. A pixel that is NaN is unknown: it has no edges.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

NUM_DIRECTIONS = 4  # right, down, down right, down left: each edge once
PIXEL_BITS, DIRECTION_SHIFT = np.uint64((1 << 30) - 1), np.uint64(30)
INFINITE_BITS = np.uint32(0x7F800000)  # of a float32; those of NaN are larger
OCTAVES = np.uint32(32 << 23)  # weights below 2^-32 of the largest are rounding, and count as 0
LOW_SHIFT, HIGH_SHIFT, DIGITS = np.uint32(6), np.uint32(17), 2048  # 28-bit keys: 11 + 11 + 6
CHUNK = 256  # edges


@intrinsic
def _as_float32(_, bits):
    """Read the bits of a uint32 as a float32."""

    def generate(context, builder, _signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.uint32), generate


@njit(cache=True, nogil=True)
def read_cells(depth, confidence, step):
    """Return (ceil(H / step), ceil(W / step)) float64 depth: of the first known pixel per block.

    NaN where no pixel of the block has positive, finite depth and confidence above 0.
    """
    height, width = depth.shape
    cells = np.full(((height + step - 1) // step, (width + step - 1) // step), np.nan)
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(i * step, min(height, (i + 1) * step)):
                for m in range(j * step, min(width, (j + 1) * step)):
                    is_open = np.isnan(cells[i, j]) and confidence[k, m] > 0
                    if is_open and 0 < depth[k, m] < np.inf:
                        cells[i, j] = depth[k, m]
    return cells


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
def sort_edges(weights, spare, edges):
    """Sort the edges by weight, ties by direction and place.

    Args:
        weights: (4, H, W) float32, NaN: no edge.
        spare: (4 H W,) uint64, overwritten.
        edges: (4 H W,) uint64, filled with key, direction (2 bits) and pixel (30 bits).

    Returns:
        The number of edges, and what to add to a key to get the bits of its weight.
    """
    bits = weights.reshape(-1).view(np.uint32)
    num_pixels = weights.shape[1] * weights.shape[2]
    top = np.uint32(0)
    for e in range(bits.size):
        if bits[e] < INFINITE_BITS:
            top = max(top, bits[e])
    base = np.uint32(top - OCTAVES + np.uint32(1)) if top >= OCTAVES else np.uint32(0)
    low, high = np.zeros(DIGITS + 1, np.uint32), np.zeros(DIGITS + 1, np.uint32)
    for e in range(bits.size):
        if bits[e] < INFINITE_BITS:
            key = np.uint32(bits[e] - base) if bits[e] > base else np.uint32(0)
            low[((key >> LOW_SHIFT) & np.uint32(DIGITS - 1)) + np.uint32(1)] += np.uint32(1)
            high[(key >> HIGH_SHIFT) + np.uint32(1)] += np.uint32(1)
    for d in range(DIGITS):
        low[d + 1] += low[d]
        high[d + 1] += high[d]
    num = np.int64(low[DIGITS])
    for direction in range(NUM_DIRECTIONS):
        tag = np.uint64(direction) << DIRECTION_SHIFT
        for p in range(num_pixels):
            value = bits[direction * num_pixels + p]
            if value < INFINITE_BITS:
                key = np.uint32(value - base) if value > base else np.uint32(0)
                place = (key >> LOW_SHIFT) & np.uint32(DIGITS - 1)
                spare[low[place]] = (np.uint64(key) << np.uint64(32)) | tag | np.uint64(p)
                low[place] += np.uint32(1)
    for e in range(num):
        digit = spare[e] >> np.uint64(32 + HIGH_SHIFT)
        edges[high[digit]] = spare[e]
        high[digit] += np.uint32(1)
    for e in range(1, num):  # the last 6 bits: few stand wrong, and none far
        edge, to = edges[e], e
        while to > 0 and edges[to - 1] > edge:
            edges[to] = edges[to - 1]
            to -= 1
        edges[to] = edge
    return num, base


@njit(cache=True, nogil=True)
def find_root(parents, pixel):
    """Return the root of a pixel's region, and halve the path to it."""
    parent = parents[pixel]
    while parent != parents[parent]:
        parents[pixel] = parents[parent]
        pixel = parents[pixel]
        parent = parents[pixel]
    return parent


@njit(cache=True, nogil=True)
def join_by_weight(edges, base, offsets, scale, parents, sizes, limits):
    """Join regions along the sorted edges while the weight is below both regions' limits.

    The limit of a region is its largest inner weight plus ``scale / size``. Edges that are
    refused are moved to the front of ``edges``.

    Returns the number of refused edges.
    """
    num_refused = 0
    kept = np.empty(CHUNK, np.uint64)
    for pixel in range(parents.size):
        parents[pixel] = pixel
        sizes[pixel] = 1
        limits[pixel] = scale
    for start in range(0, edges.size, CHUNK):
        num_kept = np.int64(0)  # first, without a branch, drop most edges inside a region
        for e in range(start, min(start + CHUNK, edges.size)):
            edge = edges[e]
            pixel = edge & PIXEL_BITS
            other = pixel + offsets[(edge >> DIRECTION_SHIFT) & np.uint64(3)]
            kept[num_kept] = edge
            num_kept += np.int64(parents[pixel] != parents[other])
        for e in range(num_kept):
            edge = kept[e]
            pixel = edge & PIXEL_BITS
            other = pixel + offsets[(edge >> DIRECTION_SHIFT) & np.uint64(3)]
            one, two = find_root(parents, pixel), find_root(parents, other)
            if one == two:
                continue
            weight = _as_float32(np.uint32(edge >> np.uint64(32)) + base)
            if weight < limits[one] and weight < limits[two]:
                if sizes[one] < sizes[two]:
                    one, two = two, one
                parents[two] = one
                sizes[one] += sizes[two]
                limits[one] = weight + scale / sizes[one]
            else:
                edges[num_refused] = edge
                num_refused += 1
    return num_refused


@njit(cache=True, nogil=True)
def join_small(edges, offsets, min_size, parents, sizes):
    """Join along the sorted edges what is smaller than ``min_size`` pixels on either side."""
    for e in range(edges.size):
        pixel = edges[e] & PIXEL_BITS
        other = pixel + offsets[(edges[e] >> DIRECTION_SHIFT) & np.uint64(3)]
        one, two = find_root(parents, pixel), find_root(parents, other)
        if one != two and (sizes[one] < min_size or sizes[two] < min_size):
            if sizes[one] < sizes[two]:
                one, two = two, one
            parents[two] = one
            sizes[one] += sizes[two]


@njit(cache=True, nogil=True)
def number_regions(image, parents, names, labels):
    """Fill (H, W) labels: regions from 1 in the order of their first pixels; 0: NaN.

    ``names`` is (H W,) int32 and overwritten. Returns the number of regions.
    """
    height, width = image.shape
    num = 0
    names[:] = 0
    for i in range(height):
        for j in range(width):
            if np.isnan(image[i, j]):
                labels[i, j] = 0
                continue
            root = find_root(parents, i * width + j)
            if names[root] == 0:
                num += 1
                names[root] = num
            labels[i, j] = names[root]
    return num


@njit(cache=True, nogil=True)
def gap_edges(image, parents, sizes, min_size):
    """Link known pixels of a row or a column that only unknown ones part, where a side is small.

    Returns (K,) weights and (K, 2) pixels.
    """
    height, width = image.shape
    weights, pairs, num = np.empty(0), np.empty((0, 2), np.int64), 0
    for fill in range(2):  # count, then fill
        if fill == 1:
            weights, pairs, num = np.empty(num), np.empty((num, 2), np.int64), 0
        above = np.full(width, -1)  # rows of the last known pixels
        for i in range(height):
            left = -1
            for j in range(width):
                if np.isnan(image[i, j]):
                    continue
                for k, m in ((i, left), (above[j], j)):
                    if k < 0 or m < 0 or (i - k) + (j - m) == 1:
                        continue
                    one = find_root(parents, np.uint64(i * width + j))
                    two = find_root(parents, np.uint64(k * width + m))
                    if one == two or (sizes[one] >= min_size and sizes[two] >= min_size):
                        continue
                    if fill == 1:
                        weights[num] = abs(image[i, j] - image[k, m])
                        pairs[num, 0], pairs[num, 1] = one, two
                    num += 1
                left, above[j] = j, i
    return weights, pairs


@njit(cache=True, nogil=True)
def join_islands(weights, pairs, min_size, parents, sizes):
    """Join along the gaps, the smallest weight first, what is smaller than ``min_size``."""
    for e in np.argsort(weights):
        one = find_root(parents, np.uint64(pairs[e, 0]))
        two = find_root(parents, np.uint64(pairs[e, 1]))
        if one != two and (sizes[one] < min_size or sizes[two] < min_size):
            if sizes[one] < sizes[two]:
                one, two = two, one
            parents[two] = one
            sizes[one] += sizes[two]
