"""Compiled parts of merging: which regions meet, their means, and who joins whom."""

from __future__ import annotations

import numpy as np
from numba import njit

from laser_slam.layers.felzenszwalb_kernels import find_root


@njit(cache=True, nogil=True)
def neighbour_pairs(labels, num):
    """Return (P, 2) pairs of different labels above 0 that meet at an edge of two pixels.

    Args:
        labels: (H, W) int32.
        num: the largest label.
    """
    height, width = labels.shape
    taken = np.zeros(1024, np.int64)
    num_pairs = 0
    for i in range(height):
        before = np.int64(0)
        for j in range(width):
            for step in range(2):
                ni, nj = i + step, j + 1 - step
                if ni == height or nj == width or labels[i, j] == labels[ni, nj]:
                    continue
                low = min(labels[i, j], labels[ni, nj])
                if low == 0:
                    continue
                key = np.int64(low) * (num + 1) + max(labels[i, j], labels[ni, nj])
                if key == before:
                    continue
                before = key
                num_pairs += _insert(taken, key)
                if 2 * num_pairs > taken.size:
                    old, taken = taken, np.zeros(4 * taken.size, np.int64)
                    for key in old:
                        if key:
                            _insert(taken, key)
    pairs = np.empty((num_pairs, 2), np.int64)
    place = 0
    for key in taken:
        if key:
            pairs[place] = key // (num + 1), key % (num + 1)
            place += 1
    return pairs


@njit(cache=True, nogil=True)
def _insert(taken, key):
    """Put a positive key in a hash set with 2^n places; return 1 where it is new, else 0."""
    place = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)
    place &= np.uint64(taken.size - 1)
    while taken[place] != 0:
        if taken[place] == key:
            return 0
        place = (place + np.uint64(1)) & np.uint64(taken.size - 1)
    taken[place] = key
    return 1


@njit(cache=True, nogil=True)
def region_means(labels, values, num):
    """Return (num + 1,) mean values and sizes of the labels; those of label 0 are 0."""
    means, sizes = np.zeros(num + 1), np.zeros(num + 1)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            label = labels[i, j]
            if label > 0:
                means[label] += values[i, j]
                sizes[label] += 1
    for label in range(1, num + 1):
        means[label] /= max(sizes[label], 1)
    return means, sizes


@njit(cache=True, nogil=True)
def join_similar(pairs, means, sizes, threshold, grows):
    """Join neighbours whose means differ by less than the threshold, the most similar first.

    Args:
        pairs: (P, 2) labels.
        means: (M + 1,) by label, overwritten where ``grows``.
        sizes: (M + 1,) by label, overwritten where ``grows``.
        threshold: in units of the means.
        grows: joined regions are compared by their common mean, until no pair is left; else by
            the means of the first, in one pass (single linkage).

    Returns:
        (M + 1,) labels from 1 without gaps, in the order of the old ones; 0 stays 0.
    """
    parents = np.arange(means.size)
    differences = np.empty(len(pairs))
    is_stable = False
    while not is_stable:
        is_stable = True
        for e in range(len(pairs)):
            one, two = find_root(parents, pairs[e, 0]), find_root(parents, pairs[e, 1])
            differences[e] = abs(means[one] - means[two])
        for e in np.argsort(differences):
            if differences[e] >= threshold:
                break
            one, two = find_root(parents, pairs[e, 0]), find_root(parents, pairs[e, 1])
            if one == two or (grows and not abs(means[one] - means[two]) < threshold):
                continue
            one, two = min(one, two), max(one, two)
            parents[two] = one
            if grows:
                total = sizes[one] + sizes[two]
                means[one] = (means[one] * sizes[one] + means[two] * sizes[two]) / total
                sizes[one] = total
                is_stable = False
    names = np.zeros(means.size, np.int64)
    num = 0
    for label in range(1, means.size):
        root = find_root(parents, label)
        if root == label:
            num += 1
            names[label] = num
        else:
            names[label] = names[root]
    return names
