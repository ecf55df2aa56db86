"""The scales of a window's layers, from the window before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import LayersConfig
from laser_slam.layers.correction import corrected_cells
from laser_slam.layers.graph import Edges, first_rows, inter_window_edges, intra_window_edges
from laser_slam.layers.opinions import Opinions, ask
from laser_slam.layers.propagation import propagate
from laser_slam.layers.shared import edge_of_cell, shared_depth
from laser_slam.types import Layers, Prediction

Labels = NDArray[np.uint16]


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
        mismatch_after: the same, after the correction; a second pass comes on top.
    """

    layers: int
    linked: int = 0
    refused: int = 0
    reached: int = 0
    curve_sigma: float = 0.0
    layer_sigma: float = 0.0
    mismatch_before: float | None = None
    mismatch_after: float | None = None


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

    Reference: LASER (arXiv:2512.13680), section 3.2 and Algorithm 1. Differs, by default: layers
    are followed by depth and poses from frame to frame; a scale is a median of log-ratios; what
    the frames' scatter explains is taken for noise, and what depth explains for a curve
    (``shrinkage``); and the window before is one opinion among those of all windows that saw a
    layer, not the truth.
    """
    before, layers_before = previous
    starts = first_rows(labels)
    _, in_a, in_b = np.intersect1d(before.frames, current.frames, return_indices=True)
    parents = layers_before.labels, layers_before.starts, in_a
    inter = inter_window_edges(parents, (labels, starts, in_b), config.tau_inter)
    if not len(inter):
        return first_layers(labels), LayerCounts(int(starts[-1]))
    followed = current if config.follow else None
    block = config.segmentation.downscale
    intra = intra_window_edges(labels, starts, config.tau_intra, followed, block)
    shared = shared_depth(previous, current, (in_a, in_b), scale, config)
    edge = edge_of_cell(inter, (layers_before, in_a), (labels, starts, in_b))
    witnesses = layers_before.witnesses[inter.parent]
    opinions = ask(shared, edge, (inter, intra), witnesses, config)
    onward = intra if config.intra else intra.chosen(np.zeros(len(intra), dtype=bool))
    layers, counts = _spread_scales(labels, (inter, onward), opinions, scale, config)
    after = scale * corrected_cells(current, layers, in_b, config)
    return layers, LayerCounts(
        **counts,
        curve_sigma=opinions.distortion.strengths[0],
        layer_sigma=opinions.distortion.strengths[1],
        mismatch_before=shared.mismatch(shared.source),
        mismatch_after=shared.mismatch(after),
    )


def _spread_scales(
    labels: Labels,
    edges: tuple[Edges, Edges],
    opinions: Opinions,
    scale: float,
    config: LayersConfig,
) -> tuple[Layers, dict[str, int]]:
    """Carry what the edges between the windows say to all frames."""
    inter, intra = edges
    starts = first_rows(labels)
    trusted = np.isfinite(opinions.log_scale)
    said = np.stack([np.exp(opinions.log_scale), opinions.witnesses], axis=1)[trusted]
    means, weights = propagate(inter.chosen(trusted), said, intra, int(starts[-1]))
    reached = weights > 0
    scales, witnesses = np.where(reached[:, None], means, 1.0).T
    knots = opinions.distortion.knots - np.log(scale)  # in the units of the current window
    layers = Layers(
        labels,
        starts,
        scales.clip(1 / config.max_scale, config.max_scale),
        witnesses,
        np.exp(np.stack([knots, opinions.distortion.curve], axis=1)),
    )
    counts = {
        "layers": int(starts[-1]),
        "linked": len(inter),
        "refused": int((~trusted).sum()),
        "reached": int(reached.sum()),
    }
    return layers, counts
