"""What the window before says of the scales of this one's layers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import LayersConfig
from laser_slam.layers.graph import Edges
from laser_slam.layers.ratio_kernels import sum_by_group
from laser_slam.layers.ratios import Pairs, Ratios, measure_ratios
from laser_slam.layers.shared import SharedDepth
from laser_slam.layers.shrinkage import NO_DISTORTION, Distortion, explain
from laser_slam.layers.tracks import Pieces, join_frames, link_tracks

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MAX_CELLS = 150_000  # of all shared frames; more only cost time
_BIN = 0.2  # of log depth: what a curve may treat differently
_SAMPLES = 10_000  # depths that tell where the bins begin


@dataclass(frozen=True)
class Opinions:
    """What each edge between the windows tells its child.

    Attributes:
        log_scale: (E,) of the child; NaN: nothing that can be trusted.
        witnesses: (E,) how many windows stand behind it, the current one included.
        distortion: what depth explains; its curve comes on top of the scales.
    """

    log_scale: Array
    witnesses: Array
    distortion: Distortion


def ask(
    shared: SharedDepth,
    edge_of_cell: Indices,
    edges: tuple[Edges, Edges],
    witnesses: Array,
    config: LayersConfig,
) -> Opinions:
    """Measure the scale of each child of an edge between the windows.

    Args:
        shared: depth in both windows.
        edge_of_cell: (K, h, w) edge of each cell; -1: none.
        edges: between the windows, and from frame to frame of the current one.
        witnesses: (E,) windows that agreed on the scale of each edge's parent.
        config: choices.
    """
    inter = edges[0]
    # The mean of n + 1 opinions lies n / (n + 1) of the way from the current one to the others'.
    gain = witnesses / (witnesses + 1) if config.memory else np.ones(len(inter))
    passed_on = np.minimum(witnesses + 1, max(config.memory, 1))
    pieces, edge = _measure(shared, edge_of_cell, config)
    if not config.shrink:
        log_scale = np.full(len(inter), np.nan)
        log_scale[edge] = gain[edge] * pieces.log_ratio
        return Opinions(log_scale, passed_on, NO_DISTORTION)
    track = link_tracks(*edges)
    observed = join_frames(pieces, track[edge], gain[edge])
    distortion = explain(observed, len(inter), with_curve=config.curve)
    log_scale = np.where(np.isin(track, observed.track), distortion.of_track[track], np.nan)
    return Opinions(log_scale, passed_on, distortion)


def _measure(
    shared: SharedDepth, edge_of_cell: Indices, config: LayersConfig
) -> tuple[Pieces, Indices]:
    """Measure each edge, apart for each range of depth; return what can be trusted and its edge."""
    used = np.flatnonzero((edge_of_cell >= 0) & (shared.weight > 0))
    thinned = 1 + len(used) // _MAX_CELLS
    used = used[::thinned]
    edge = edge_of_cell.reshape(-1)[used]
    source, target, weight = (
        maps.reshape(-1)[used] for maps in (shared.source, shared.target, shared.weight)
    )
    log_depth = np.log(source)
    depth_bin, num_bins = _bins(log_depth, is_split=config.shrink)
    occupied, group = _numbered(edge * num_bins + depth_bin)
    ratios = measure_ratios(Pairs(group, source, target, weight, len(occupied)), config.scale)
    _, height, width = edge_of_cell.shape
    trusted = _is_trusted(ratios, height * width // thinned, config)
    place = used % (height * width)
    sums = sum_by_group(group, place, width, log_depth, len(occupied))
    depth, column, row = sums / ratios.support
    pieces = Pieces(
        log_ratio=ratios.log_ratio[trusted],
        support=ratios.support[trusted],
        depth_bin=(occupied % num_bins)[trusted],
        log_depth=depth[trusted],
        place=np.stack([row, column], axis=1)[trusted] / width,
    )
    return pieces, (occupied // num_bins)[trusted]


def _bins(log_depth: NDArray[np.float32], *, is_split: bool) -> tuple[Indices, int]:
    """Return (P,) the range of depth of each pixel, and how many ranges there are."""
    if not is_split or not len(log_depth):
        return np.zeros(len(log_depth), np.int64), 1
    middle = np.median(log_depth[:: len(log_depth) // _SAMPLES + 1])
    steps = (log_depth - middle) / _BIN
    bins = np.floor(steps - steps.min()).astype(np.int64)
    return bins, int(bins.max()) + 1


def _numbered(values: Indices) -> tuple[Indices, Indices]:
    """Return the values that occur, rising, and for each of ``values`` which one it is."""
    occurs = np.bincount(values, minlength=1) > 0
    return np.flatnonzero(occurs), (np.cumsum(occurs) - 1)[values]


def _is_trusted(ratios: Ratios, num_cells: int, config: LayersConfig) -> NDArray[np.bool_]:
    enough = ratios.support >= max(config.min_support * num_cells, 1)
    one_scale = ratios.spread <= config.max_spread
    plausible = np.abs(ratios.log_ratio) <= np.log(config.max_scale)
    return np.asarray(enough & one_scale & plausible)
