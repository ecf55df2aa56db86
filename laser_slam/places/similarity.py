"""How much the keyframes of a run resemble each other, in a map that stays small."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.places.index import PlaceIndex

Array32 = NDArray[np.float32]

MAX_CELLS = 400  # along a side of the map
MAX_PAIRS = 50_000_000  # keyframes compared with keyframes: about three seconds of one core
ROWS = 64  # compared at a time: 26 MB for 100,000 keyframes


@dataclass(frozen=True)
class SimilarityMap:
    """How much keyframes resemble each other, in cells of one or several.

    Attributes:
        similarities: (C, C) the greatest of each pair of cells, symmetric.
        frames: (N,) rising indices in the sequence of the keyframes.
        per_cell: keyframes along the side of a cell; the last one may have fewer.
    """

    similarities: Array32
    frames: NDArray[np.int64]
    per_cell: int


def map_similarities(index: PlaceIndex, frames: NDArray[np.int64]) -> SimilarityMap:
    """Compare all keyframes with each other, as they look once the whole run is known.

    Of a long run only every so many-th keyframe is compared with all, some in each cell; memory
    is that of the map and of a few rows.

    Args:
        index: all places of the run.
        frames: (N,) rising indices in the sequence of these places.
    """
    num = len(index)
    per_cell = max(1, math.ceil(num / MAX_CELLS))
    cells = math.ceil(num / per_cell)
    out = np.full((cells, cells), -1, np.float32)
    step = min(per_cell, math.ceil(num * num / 2 / MAX_PAIRS)) or 1
    probes = np.arange(0, num, step)
    for start in range(0, len(probes), ROWS):
        rows = probes[start : start + ROWS]
        stop = int(rows[-1]) + 1
        found = index.similarities(index.descriptors(rows), stop)
        greatest = np.maximum.reduceat(found, np.arange(0, stop, per_cell), axis=1)
        np.maximum.at(out[:, : greatest.shape[1]], rows // per_cell, greatest)
    return SimilarityMap(np.maximum(out, out.T), frames, per_cell)
