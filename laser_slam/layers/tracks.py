"""Layers of the shared frames that are one thing seen again and again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from laser_slam.layers.graph import Edges
from laser_slam.layers.shrinkage import Observations

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MIN_FRAMES = 2  # that must agree, where there are as many
_OUTLIER = 3.0  # noise sigmas from the median of the frames
_FEW_FRAMES = 1.2  # the median of few frames lies too close to them
_TWO_FRAMES = 2.1  # sigmas in the median distance from the mean of two frames
_NOISE_UNSEEN = 0.05  # log-ratio, where no track has frames enough to show its noise
_LEAST_NOISE = 2e-3
_NOISE_SUPPORT = 60.0  # cells with which a layer's own noise counts as much as what all share


@dataclass(frozen=True)
class Pieces:
    """What one shared frame says of one layer in one range of depth.

    Attributes:
        log_ratio: (G,) by which depth should grow.
        support: (G,) cells behind it.
        depth_bin: (G,) which range of depth.
        log_depth: (G,) mean.
        place: (G, 2) centre in the image, in image widths.
    """

    log_ratio: Array
    support: Indices
    depth_bin: Indices
    log_depth: Array
    place: Array


def link_tracks(inter: Edges, intra: Edges) -> Indices:
    """Return (E,) the track of each edge's child; children in one track prefer each other."""
    children, place = np.unique(inter.child, return_inverse=True)
    inside = np.isin(intra.parent, children) & np.isin(intra.child, children)
    parent, child, iou = intra.parent[inside], intra.child[inside], intra.iou[inside]
    mutual = _is_best(parent, iou) & _is_best(child, iou)
    rows = np.searchsorted(children, parent[mutual]), np.searchsorted(children, child[mutual])
    links = coo_array((np.ones(int(mutual.sum())), rows), shape=(len(children), len(children)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)[place]


def join_frames(pieces: Pieces, track: Indices, gain: Array) -> Observations:
    """Join what the frames say of the same track at the same depth; their scatter is the noise.

    What a single frame says against the others is an outlier, and what only one frame says is
    no witness: blobs of wrong depth differ from frame to frame, distortion stays.

    Args:
        pieces: of all shared frames.
        track: (G,) of each piece.
        gain: (G,) how much of its ratio each piece asks for.
    """
    _, first, of = np.unique(
        np.stack([track, pieces.depth_bin]), axis=1, return_index=True, return_inverse=True
    )
    wanted = gain * pieces.log_ratio
    num = np.bincount(of)
    error = np.abs(wanted - _group_median(wanted, of)[of])
    noise = max(_noise(error, num[of]), _LEAST_NOISE)
    kept = error <= _OUTLIER * noise
    frames = np.bincount(of, kept)
    cells = np.bincount(of, kept * pieces.support)
    seen = np.flatnonzero(frames >= min(_MIN_FRAMES, num.max(initial=1)))
    weight = kept * pieces.support
    cells, frames = cells[seen], frames[seen]
    return Observations(
        log_ratio=np.bincount(of, weight * wanted)[seen] / cells,
        variance=noise**2 * (1 / frames + _NOISE_SUPPORT / cells),
        track=track[first][seen],
        log_depth=np.bincount(of, weight * pieces.log_depth)[seen] / cells,
        place=pieces.place[first][seen],
    )


def _noise(error: Array, num: Indices) -> float:
    """Estimate the standard deviation of one frame's ratio from (G,) distances to the median.

    Args:
        error: absolute.
        num: (G,) frames in the group of each.
    """
    for enough, factor in ((num >= 3, _FEW_FRAMES * 1.4826), (num == 2, _TWO_FRAMES)):
        if enough.any():
            return factor * float(np.median(error[enough]))
    return _NOISE_UNSEEN


def _is_best(group: Indices, value: Array) -> NDArray[np.bool_]:
    """Return (E,) True for the largest value of each group."""
    best = np.full(int(group.max(initial=0)) + 1, -np.inf)
    np.maximum.at(best, group, value)
    return np.asarray(value >= best[group])


def _group_median(values: Array, group: Indices) -> Array:
    order = np.lexsort((values, group))
    counts = np.bincount(group)
    first = np.cumsum(counts) - counts
    low, high = order[first + (counts - 1) // 2], order[first + counts // 2]
    return np.asarray(0.5 * (values[low] + values[high]))
