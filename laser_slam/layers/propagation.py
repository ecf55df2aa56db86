"""Scales along the edges of the layer graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.layers.graph import Edges

Array = NDArray[np.float64]


def propagate(inter: Edges, measured: Array, intra: Edges, num_layers: int) -> tuple[Array, Array]:
    """Give each layer the IoU-weighted mean of what its parents say.

    Args:
        inter: edges from the window before.
        measured: (E, ...) what each of them says of its child, such as a scale.
        intra: edges from frame to frame, ordered by frame.
        num_layers: layers of the window.

    Returns:
        (num_layers, ...) the means, 0 where nothing arrived, and (num_layers,) the IoU behind them.

    Reference: LASER (arXiv:2512.13680), Algorithm 1.
    """
    sums = np.zeros((num_layers, *measured.shape[1:]))
    weights = np.zeros(num_layers)
    _add(sums, weights, inter.child, inter.iou, measured)
    for frame in np.unique(intra.frame):
        here = intra.frame == frame
        parent, child, iou = intra.parent[here], intra.child[here], intra.iou[here]
        known = weights[parent] > 0
        parent, child, iou = parent[known], child[known], iou[known]
        # A parent's frame is done before its children's begins, so that its mean is final.
        means = sums[parent] / _beside(weights[parent], sums)
        _add(sums, weights, child, iou, means)
    reached = weights > 0
    sums[reached] /= _beside(weights[reached], sums)
    return sums, weights


def _add(sums: Array, weights: Array, child: NDArray[np.int64], iou: Array, values: Array) -> None:
    np.add.at(sums, child, _beside(iou, values) * values)
    np.add.at(weights, child, iou)


def _beside(weights: Array, values: Array) -> Array:
    """Give (E,) weights the trailing axes of (E, ...) values."""
    return weights.reshape(-1, *[1] * (values.ndim - 1))
