"""The scales of a window's layers, from the window before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from laser_slam.config import LayersConfig
from laser_slam.layers.correction import corrected_depth
from laser_slam.layers.graph import (
    Edges,
    first_rows,
    inter_window_edges,
    intra_window_edges,
)
from laser_slam.layers.propagation import propagate
from laser_slam.layers.ratios import Pairs, Ratios, measure_ratios
from laser_slam.layers.shrinkage import Distortion, Observations, explain
from laser_slam.types import Layers, Prediction

Array = NDArray[np.float64]
Float = NDArray[np.float32]
Indices = NDArray[np.int64]
Labels = NDArray[np.uint16]

_BIN = 0.2  # of log depth: what a curve may treat differently
_NO_BINS = 1


@dataclass(frozen=True)
class LayerCounts:
    """What became of one window's layers.

    Attributes:
        layers: in all frames of the window.
        linked: edges from layers of the window before.
        refused: edges whose scale was not trusted.
        reached: layers that a scale came to.
        curve_sigma: strength of the distortion that depends on depth: a log's standard deviation.
        layer_sigma: strength of the layers' own.
        mismatch_before: median absolute log-ratio of the shared depth; None: nothing shared.
        mismatch_after: the same, after the correction.
    """

    layers: int
    linked: int = 0
    refused: int = 0
    reached: int = 0
    curve_sigma: float = 0.0
    layer_sigma: float = 0.0
    mismatch_before: float | None = None
    mismatch_after: float | None = None


@dataclass(frozen=True)
class _Shared:
    """Cells of the shared frames, (K, h, w) each.

    Attributes:
        source: depth in the current window, scaled by its registration.
        target: depth in the window before, corrected.
        weight: trust; 0 where either is unknown.
    """

    source: Float
    target: Float
    weight: Float


def first_layers(labels: Labels) -> Layers:
    """Return the layers of a window that has none before it: all scales 1.

    Args:
        labels: (N, h, w) from 1 in each frame; 0: unknown.
    """
    starts = first_rows(labels)
    ones = np.ones(starts[-1])
    return Layers(labels, starts, ones, ones.copy(), np.empty((0, 2)))


def align_layers(
    previous: tuple[Prediction, Layers],
    current: Prediction,
    labels: Labels,
    scale: float,
    config: LayersConfig,
) -> tuple[Layers, LayerCounts]:
    """Give each layer of the current window the scale that fits it to the window before.

    Args:
        previous: the window before, as predicted, and its layers.
        current: the window to correct.
        labels: (N, h, w) its layers, from 1 in each frame; 0: unknown.
        scale: of its registration, ``previous_from_current``; the layers' scales come on top.
        config: thresholds and choices.

    Returns:
        The layers with scales, and what became of them. Layers that no edge reaches keep 1, as do
        all of a window that shares no frame with the one before.

    Reference: LASER (arXiv:2512.13680), section 3.2 and Algorithm 1. Differs, by default: scales
    are medians of log-ratios over pixels weighted by confidence; what frame-to-frame scatter
    explains is taken for noise, and what depth explains for a curve (``shrinkage``); the window
    before is one opinion among those of all windows that saw the layer, not the truth.
    """
    before, layers_before = previous
    starts = first_rows(labels)
    _, in_a, in_b = np.intersect1d(before.frames, current.frames, return_indices=True)
    inter = inter_window_edges(
        (layers_before.labels, layers_before.starts, in_a), (labels, starts, in_b), config.tau_inter
    )
    intra = intra_window_edges(labels, starts, config.tau_intra)
    if not len(inter):
        return first_layers(labels), LayerCounts(int(starts[-1]))
    shared = _shared_depth(previous, current, (in_a, in_b), scale, config)
    edge_of_cell = _edge_of_cell(inter, (layers_before, in_a), (labels, starts, in_b))
    measured, distortion = _measure(shared, edge_of_cell, (inter, intra), layers_before, config)
    known = np.isfinite(measured[:, 0])
    kept = Edges(*(getattr(inter, name)[known] for name in ("parent", "child", "iou", "frame")))
    onward = intra if config.intra else _none_of(intra)
    means, weights = propagate(kept, measured[known], onward, int(starts[-1]))
    reached = weights > 0
    scales = np.where(reached, means[:, 0], 1.0).clip(1 / config.max_scale, config.max_scale)
    curve = np.exp(np.stack([distortion.knots - np.log(scale), distortion.curve], axis=1))
    layers = Layers(labels, starts, scales, np.where(reached, means[:, 1], 1.0), curve)
    after = corrected_depth(current, layers, in_b, config)
    counts = LayerCounts(
        layers=int(starts[-1]),
        linked=len(inter),
        refused=int((~known).sum()),
        reached=int(reached.sum()),
        curve_sigma=distortion.strengths[0],
        layer_sigma=distortion.strengths[1],
        mismatch_before=_mismatch(shared, shared.source),
        mismatch_after=_mismatch(shared, scale * _cells(after, config)),
    )
    return layers, counts


def _cells(maps: Float, config: LayersConfig) -> Float:
    block = config.segmentation.downscale
    return maps[:, ::block, ::block]


def _shared_depth(
    previous: tuple[Prediction, Layers],
    current: Prediction,
    shared: tuple[Indices, Indices],
    scale: float,
    config: LayersConfig,
) -> _Shared:
    (before, layers_before), (in_a, in_b) = previous, shared
    target = _cells(corrected_depth(before, layers_before, in_a, config), config)
    source = np.float32(scale) * _cells(current.depth[in_b], config)
    trust = np.sqrt(
        _cells(before.confidence[in_a], config) * _cells(current.confidence[in_b], config)
    )
    weight = trust if config.confidence else (trust > 0).astype(np.float32)
    known = (source > 0) & (target > 0) & np.isfinite(source) & np.isfinite(target)
    return _Shared(source, target, np.where(known, weight, np.float32(0)))


def _edge_of_cell(
    inter: Edges, parents: tuple[Layers, Indices], children: tuple[Labels, Indices, Indices]
) -> Indices:
    """Return the (K, h, w) edge that each cell of the shared frames is part of; -1: none."""
    (layers, in_a), (labels, starts, in_b) = parents, children
    out = np.empty((len(in_a), *labels.shape[1:]), np.int64)
    for k, (i, j) in enumerate(zip(in_a, in_b, strict=True)):
        here = np.flatnonzero(inter.frame == j)
        table = np.full(
            (int(layers.labels[i].max()) + 1, int(labels[j].max()) + 1), -1, dtype=np.int64
        )
        table[inter.parent[here] - layers.starts[i] + 1, inter.child[here] - starts[j] + 1] = here
        out[k] = table[layers.labels[i], labels[j]]
    return out


def _measure(
    shared: _Shared,
    edge_of_cell: Indices,
    edges: tuple[Edges, Edges],
    layers_before: Layers,
    config: LayersConfig,
) -> tuple[Array, Distortion]:
    """Return (E, 2) scale and witnesses that each edge gives its child, and the distortion."""
    inter, intra = edges
    used = (edge_of_cell >= 0) & (shared.weight > 0)
    edge, source = edge_of_cell[used], shared.source[used]
    log_depth = np.log(source)
    bins, num_bins = np.zeros(len(edge), np.int64), _NO_BINS
    if config.shrink and len(edge):
        steps = (log_depth - np.median(log_depth)) / _BIN
        bins = np.floor(steps - steps.min()).astype(np.int64)
        num_bins = int(bins.max()) + 1
    group = edge * num_bins + bins
    pairs = Pairs(group, source, shared.target[used], shared.weight[used], len(inter) * num_bins)
    ratios = measure_ratios(pairs, config.scale)
    trusted = _is_trusted(ratios, edge_of_cell[0].size, config)
    witnesses = layers_before.witnesses[inter.parent]
    gain = witnesses / (witnesses + 1) if config.memory else np.ones(len(inter))
    passed_on = np.minimum(witnesses + 1, max(config.memory, 1))
    if not config.shrink:
        log_scale = np.where(trusted, ratios.log_ratio, np.nan) * gain
        nothing = Distortion(np.empty(0), np.empty(0), np.empty(0), (0.0, 0.0))
        return np.stack([np.exp(log_scale), passed_on], axis=1), nothing
    at_depth = np.bincount(group, log_depth, minlength=pairs.num_groups) / np.maximum(
        ratios.support, 1
    )
    track = _tracks(inter, intra)
    groups = np.flatnonzero(trusted)
    edge_of_group = groups // num_bins
    observed = _observe(
        ratios.log_ratio[groups] * gain[edge_of_group],
        ratios.support[groups],
        (track[edge_of_group], groups % num_bins),
        at_depth[groups],
    )
    distortion = explain(observed, int(track.max()) + 1, with_curve=config.curve)
    measured = np.stack([np.exp(distortion.of_track[track]), passed_on], axis=1)
    measured[~np.isin(np.arange(len(inter)), edge_of_group)] = np.nan
    return measured, distortion


def _is_trusted(ratios: Ratios, num_cells: int, config: LayersConfig) -> NDArray[np.bool_]:
    enough = ratios.support >= max(config.min_support * num_cells, 1)
    with np.errstate(invalid="ignore"):
        one_scale = ratios.spread <= config.max_spread
        plausible = np.abs(ratios.log_ratio) <= np.log(config.max_scale)
    return np.asarray(enough & one_scale & plausible)


def _tracks(inter: Edges, intra: Edges) -> Indices:
    """Return (E,) which layers of the shared frames are one thing seen again and again."""
    children, place = np.unique(inter.child, return_inverse=True)
    inside = np.isin(intra.parent, children) & np.isin(intra.child, children)
    parent, child, iou = intra.parent[inside], intra.child[inside], intra.iou[inside]
    mutual = _is_best(parent, iou) & _is_best(child, iou)
    rows = np.searchsorted(children, parent[mutual]), np.searchsorted(children, child[mutual])
    links = coo_array((np.ones(int(mutual.sum())), rows), shape=(len(children), len(children)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)[place]


def _is_best(group: Indices, value: Array) -> NDArray[np.bool_]:
    """Return (E,) True for the largest value of each group."""
    if not len(group):
        return np.zeros(0, dtype=bool)
    best = np.full(int(group.max()) + 1, -np.inf)
    np.maximum.at(best, group, value)
    return np.asarray(value >= best[group])


def _observe(
    log_ratio: Array, support: Indices, place: tuple[Indices, Indices], log_depth: Array
) -> Observations:
    """Join what the shared frames say of the same track at the same depth."""
    track, depth_bin = place
    _, of = np.unique(np.stack([track, depth_bin]), axis=1, return_inverse=True)
    num = np.bincount(of)
    typical = _group_median(log_ratio, of)
    error = np.abs(log_ratio - typical[of])
    again = num[of] >= 3
    noise = 1.4826 * float(np.median(error[again])) * 1.2 if again.any() else _UNSEEN_NOISE
    noise = max(noise, _LEAST_NOISE)
    kept = error <= 3 * noise
    weight = kept * support
    total = np.maximum(np.bincount(of, weight), 1e-9)
    mean = np.bincount(of, weight * log_ratio) / total
    frames = np.maximum(np.bincount(of, kept), 1)
    first = np.unique(of, return_index=True)[1]
    return Observations(
        log_ratio=mean,
        variance=noise**2 * (1 + _NOISE_SUPPORT * frames / total) / frames,
        track=track[first],
        log_depth=np.bincount(of, weight * log_depth) / total,
    )


_UNSEEN_NOISE = 0.05
_LEAST_NOISE = 2e-3
_NOISE_SUPPORT = 60.0  # cells with which a layer's own noise counts as much as what all share


def _group_median(values: Array, group: Indices) -> Array:
    order = np.lexsort((values, group))
    counts = np.bincount(group)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    low, high = order[first + (counts - 1) // 2], order[first + counts // 2]
    return np.asarray(0.5 * (values[low] + values[high]))


def _none_of(edges: Edges) -> Edges:
    return Edges(edges.parent[:0], edges.child[:0], edges.iou[:0], edges.frame[:0])


def _mismatch(shared: _Shared, source: Float) -> float | None:
    """Return the median absolute log-ratio of the depths that both windows know."""
    used = shared.weight > 0
    if not used.any():
        return None
    return float(np.median(np.abs(np.log(source[used] / shared.target[used]))))
