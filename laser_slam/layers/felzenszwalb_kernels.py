"""Compiled parts of the segmentation: union-find over sorted edges, small regions.

Regions live in a forest over the pixels: ``parents[p]`` leads to the root of p's region, whose
``sizes`` counts its pixels. A pixel that is NaN is unknown: it has no edges.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from laser_slam.layers.edge_kernels import DIRECTION_SHIFT, PIXEL_BITS, part_edges, sort_edges

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
    cells = np.empty(((height + step - 1) // step, (width + step - 1) // step))
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            block = slice(i * step, (i + 1) * step), slice(j * step, (j + 1) * step)
            z = depth[i * step, j * step]
            is_known = (z > 0) & (z < np.inf) & (confidence[i * step, j * step] > 0)
            cells[i, j] = z if is_known else _first_known(depth[block], confidence[block])
    return cells


@njit(cache=True, nogil=True)
def _first_known(depth, confidence):
    for k in range(depth.shape[0]):
        for m in range(depth.shape[1]):
            if 0 < depth[k, m] < np.inf and confidence[k, m] > 0:
                return np.float64(depth[k, m])
    return np.nan


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
def join_by_weight(weights, work, offsets, scale, forest):
    """Join regions by rising weight while it is below both regions' limits.

    The limit of a region is its largest inner weight plus ``scale / size``. What lies inside a
    region by the time that its portion's turn comes need not be sorted.

    Args:
        weights: (4, H, W) float32, NaN: no edge.
        work: two (4 H W,) uint64; the first begins with the refused edges afterwards, sorted.
        offsets: (4,) uint64 from a pixel to its neighbours.
        scale: in units of the weights.
        forest: ``parents``, ``sizes`` and ``limits``.

    Returns:
        The number of refused edges.
    """
    edges, spare = work
    parents, sizes, limits = forest
    for pixel in range(parents.size):
        parents[pixel] = pixel
        sizes[pixel] = 1
        limits[pixel] = scale
    ends = spare.view(np.uint32).reshape(-1, 2)
    start, least, num_refused = np.int64(0), np.int64(0), np.int64(0)
    for end, above in part_edges(weights, edges):
        some = edges[start:end]
        num = start + _between_regions(some, offsets, parents, some, ends)
        sort_edges(edges[start:num], spare, least, above)
        refused = edges[num_refused:]
        num_refused += _join_sorted(edges[start:num], offsets, scale, forest, refused)
        start, least = end, above
    return num_refused


@njit(cache=True, nogil=True)
def _join_sorted(edges, offsets, scale, forest, refused):
    """Join along sorted edges; fill the first of ``refused``, and return their number."""
    parents, sizes, limits = forest
    num_refused = np.int64(0)
    kept, ends = np.empty(CHUNK, np.uint64), np.empty((CHUNK, 2), np.uint32)
    for start in range(0, edges.size, CHUNK):
        for e in range(
            _between_regions(edges[start : start + CHUNK], offsets, parents, kept, ends)
        ):
            one, two = find_root(parents, ends[e, 0]), find_root(parents, ends[e, 1])
            if one == two:
                continue
            weight = _as_float32(np.uint32(kept[e] >> np.uint64(32)))
            if weight < min(limits[one], limits[two]):
                if sizes[one] < sizes[two]:
                    one, two = two, one
                parents[two] = one
                sizes[one] += sizes[two]
                limits[one] = weight + scale / sizes[one]
            else:
                refused[num_refused] = kept[e]
                num_refused += 1
    return num_refused


@njit(cache=True, nogil=True)
def _between_regions(edges, offsets, parents, kept, ends):
    """Collect, without a branch, the edges that do not seem to lie inside a region.

    Args:
        edges: (E,) uint64.
        offsets: (4,) uint64.
        parents: (H W,) uint32; paths are shortened.
        kept: at least (E,) uint64, filled; may be ``edges``.
        ends: at least (E, 2) uint32, filled with pixels nearer to the roots.

    Returns:
        The number of edges that were kept.
    """
    num = np.int64(0)
    for edge in edges:
        pixel = edge & PIXEL_BITS
        other = pixel + offsets[(edge >> DIRECTION_SHIFT) & np.uint64(3)]
        one, two = parents[parents[pixel]], parents[parents[other]]
        parents[pixel], parents[other] = one, two
        kept[num], ends[num, 0], ends[num, 1] = edge, one, two
        num += np.int64(one != two)
    return num


@njit(cache=True, nogil=True)
def join_small(edges, offsets, min_size, parents, sizes):
    """Join along the sorted edges what is smaller than ``min_size`` pixels on either side."""
    kept, ends = np.empty(CHUNK, np.uint64), np.empty((CHUNK, 2), np.uint32)
    for start in range(0, edges.size, CHUNK):
        for e in range(
            _between_regions(edges[start : start + CHUNK], offsets, parents, kept, ends)
        ):
            one, two = find_root(parents, ends[e, 0]), find_root(parents, ends[e, 1])
            if one != two and min(sizes[one], sizes[two]) < min_size:
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
