"""Join neighbouring regions that lie at nearly the same depth."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from laser_slam.layers.merging_kernels import join_similar, neighbour_pairs, region_means


def merge_regions(
    labels: NDArray[np.int32],
    values: NDArray[np.float64],
    threshold: float,
    rule: Literal["robust", "range"],
) -> NDArray[np.int32]:
    """Join regions that share a border and differ by less than the threshold.

    Args:
        labels: (h, w) regions, from 1 without gaps; 0: unknown, joins nothing.
        values: (h, w) what the regions were found in, e.g. log depth.
        threshold: between mean values, in their unit; 0 joins nothing.
        rule: ``robust`` takes the most similar pair first and then compares the common mean,
            so that a slope is not swallowed step by step; ``range`` compares the means of the
            regions as they were found, and chains (single linkage), as the official code does.

    Returns:
        (h, w) labels from 1 without gaps, in the order of the old ones.
    """
    num = int(labels.max(initial=0))
    if num < 2 or threshold <= 0:
        return labels
    pairs = neighbour_pairs(labels, num)
    means, sizes = region_means(labels, values, num)
    names = join_similar(pairs, means, sizes, threshold, rule == "robust")
    return np.asarray(names[labels], dtype=np.int32)
