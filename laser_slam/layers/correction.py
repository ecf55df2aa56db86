"""Layer scales on depth maps, without torn surfaces."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import LayersConfig
from laser_slam.layers.correction_kernels import add_curve, scale_depth, spread_scales
from laser_slam.types import Layers, Prediction

Float = NDArray[np.float32]
_Curve = tuple[np.float32, np.float32, Float]  # first log depth, knots per unit of it, log factors

MAX_STEP = np.float32(0.03)  # of log depth from cell to cell, beyond which a surface ends
_KNOTS = 4096  # of the curve, evenly spaced: no search; 1e-3 of log depth apart


def apply_layers(prediction: Prediction, layers: Layers, config: LayersConfig) -> Prediction:
    """Multiply depth by the factors of its layers; points move along their rays.

    Args:
        prediction: as the backbone gave it.
        layers: of the same window.
        config: how far scales blend on surfaces that go on across the border of two layers.
    """
    if _changes_nothing(layers):
        return prediction
    block = config.segmentation.downscale
    if block == 1:
        frames = range(len(prediction.frames))
        return replace(prediction, depth=corrected_cells(prediction, layers, frames, config))
    out, curve = np.empty_like(prediction.depth, order="C"), _even(layers.curve)
    for frame, depth in enumerate(prediction.depth):
        cells = _cells(depth, config)
        factors = _factors(cells, layers, frame, curve, config)
        scale_depth(depth, cells, factors, block, out[frame])
    return replace(prediction, depth=out)


def corrected_cells(
    prediction: Prediction, layers: Layers, frames: Iterable[int], config: LayersConfig
) -> Float:
    """Return the (K, h, w) corrected depth of the cells of some frames, in window units."""
    chosen = list(frames)
    out = np.array([_cells(prediction.depth[frame], config) for frame in chosen])
    if not _changes_nothing(layers):
        curve = _even(layers.curve)
        for k, frame in enumerate(chosen):
            out[k] *= _factors(out[k], layers, frame, curve, config)
    return out


def _changes_nothing(layers: Layers) -> bool:
    return not len(layers.curve) and bool((layers.scales == 1).all())


def _cells(depth: Float, config: LayersConfig) -> Float:
    block = config.segmentation.downscale
    return np.ascontiguousarray(depth[::block, ::block])


def _even(curve: NDArray[np.float64]) -> _Curve | None:
    """Return a curve at evenly spaced knots; None: no curve."""
    if not len(curve):
        return None
    depths, factors = np.log(curve).T
    even = np.linspace(depths[0], depths[-1], _KNOTS)
    per_unit = (_KNOTS - 1) / max(depths[-1] - depths[0], 1e-6)
    values = np.interp(even, depths, factors).astype(np.float32)
    return np.float32(depths[0]), np.float32(per_unit), values


def _factors(
    cells: Float, layers: Layers, frame: int, curve: _Curve | None, config: LayersConfig
) -> Float:
    """Return the (h, w) factor of each cell of a frame; 1 where depth is unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log_depth = np.log(cells)
    scales = layers.scales[layers.starts[frame] : layers.starts[frame + 1]]
    by_label = np.log(np.append(1.0, scales)).astype(np.float32)
    reach = config.feather / config.segmentation.downscale
    fade = np.float32(np.exp(-1 / reach) if reach > 0 else 0.0)
    out: Float = spread_scales(layers.labels[frame], by_label, log_depth, fade, MAX_STEP)
    if curve is not None:
        add_curve(out, log_depth, *curve)
    return np.exp(out, out=out)
