"""The depth of the frames that two windows share, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import LayersConfig
from laser_slam.layers.correction import corrected_cells
from laser_slam.layers.graph import Edges
from laser_slam.types import Layers, Prediction

Float = NDArray[np.float32]
Indices = NDArray[np.int64]
Labels = NDArray[np.uint16]

_SAMPLES = 20_000  # cells that tell how far two windows are apart


@dataclass(frozen=True)
class SharedDepth:
    """Cells of the shared frames, (K, h, w) each.

    Attributes:
        source: depth in the current window, scaled by its registration.
        target: depth in the window before, its layers' scales applied.
        weight: trust; 0 where either is unknown.
    """

    source: Float
    target: Float
    weight: Float

    def mismatch(self, source: Float) -> float | None:
        """Return the median absolute log-ratio between the windows; None: nothing is shared.

        Args:
            source: (K, h, w) depth of the current window, perhaps corrected.
        """
        used = np.flatnonzero(self.weight > 0)
        if not len(used):
            return None
        used = used[:: len(used) // _SAMPLES + 1]
        ratios = source.reshape(-1)[used] / self.target.reshape(-1)[used]
        return float(np.median(np.abs(np.log(ratios))))


def shared_depth(
    previous: tuple[Prediction, Layers],
    current: Prediction,
    shared: tuple[Indices, Indices],
    scale: float,
    config: LayersConfig,
) -> SharedDepth:
    """Collect what two windows say of the frames they share.

    Args:
        previous: the window before, as predicted, and its layers.
        current: the window to correct.
        shared: (K,) where the shared frames are in the one and in the other.
        scale: ``previous_from_current``.
        config: how cells are taken and trusted.
    """
    (before, layers_before), (in_a, in_b) = previous, shared
    target = corrected_cells(before, layers_before, in_a, config)
    source = np.float32(scale) * cells(current.depth[in_b], config)
    trust = np.sqrt(
        cells(before.confidence[in_a], config) * cells(current.confidence[in_b], config)
    )
    weight = trust if config.confidence else (trust > 0).astype(np.float32)
    known = (source > 0) & (target > 0) & np.isfinite(source) & np.isfinite(target)
    return SharedDepth(source, target, np.where(known, weight, np.float32(0)))


def cells(maps: Float, config: LayersConfig) -> Float:
    """Return the (..., h, w) values that stand for the cells of (..., H, W) maps."""
    block = config.segmentation.downscale
    return maps[..., ::block, ::block]


def edge_of_cell(
    inter: Edges, parents: tuple[Layers, Indices], children: tuple[Labels, Indices, Indices]
) -> Indices:
    """Return the (K, h, w) edge that each cell of the shared frames is part of; -1: none.

    Args:
        inter: edges between the windows.
        parents: layers of the window before, and (K,) where the shared frames are in it.
        children: labels (N, h, w) of the current window, ``starts`` of its rows, and (K,) where
            the shared frames are in it.
    """
    (layers, in_a), (labels, starts, in_b) = parents, children
    out = np.empty((len(in_a), *labels.shape[1:]), np.int64)
    for k, (i, j) in enumerate(zip(in_a, in_b, strict=True)):
        here = np.flatnonzero(inter.frame == j)
        size = int(layers.labels[i].max()) + 1, int(labels[j].max()) + 1
        table = np.full(size, -1, dtype=np.int64)
        table[inter.parent[here] - layers.starts[i] + 1, inter.child[here] - starts[j] + 1] = here
        out[k] = table[layers.labels[i], labels[j]]
    return out
