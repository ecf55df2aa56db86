"""Layer scales on depth maps, without torn surfaces."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import LayersConfig
from laser_slam.layers.alignment_kernels import scale_depth, smooth_along_surfaces
from laser_slam.types import Layers, Prediction

Float = NDArray[np.float32]


def apply_layers(prediction: Prediction, layers: Layers, config: LayersConfig) -> Prediction:
    """Multiply depth by the factors of its layers; points move along their rays.

    Args:
        prediction: as the backbone gave it.
        layers: of the same window.
        config: how far scales blend on surfaces that go on across the border of two layers.
    """
    frames = range(len(prediction.frames))
    return replace(prediction, depth=corrected_depth(prediction, layers, frames, config))


def corrected_depth(
    prediction: Prediction, layers: Layers, frames: Iterable[int], config: LayersConfig
) -> Float:
    """Return the (K, H, W) corrected depth of some frames of the window, in window units."""
    chosen = list(frames)
    out: Float = np.empty((len(chosen), *prediction.depth.shape[1:]), np.float32)

    def correct(k: int) -> None:
        depth = prediction.depth[chosen[k]]
        _correct(depth, _of_frame(layers, chosen[k]), layers.curve, config, out[k])

    if _changes_nothing(layers):
        out[:] = prediction.depth[chosen]
        return out
    with ThreadPoolExecutor() as pool:
        list(pool.map(correct, range(len(chosen))))
    return out


def _changes_nothing(layers: Layers) -> bool:
    return not len(layers.curve) and bool((layers.scales == 1).all())


def _of_frame(layers: Layers, frame: int) -> NDArray[np.float32]:
    """Return the (h, w) log factor of each cell from its layer; 0: unknown."""
    rows = layers.scales[layers.starts[frame] : layers.starts[frame + 1]]
    table = np.concatenate([[0.0], np.log(rows)]).astype(np.float32)
    out: Float = table[layers.labels[frame]]
    return out


def _correct(
    depth: Float, log_factor: Float, curve: NDArray[np.float64], config: LayersConfig, out: Float
) -> None:
    block = config.segmentation.downscale
    cells = np.ascontiguousarray(depth[::block, ::block])
    with np.errstate(divide="ignore", invalid="ignore"):
        log_depth = np.log(cells)
    if config.feather > 0:
        smooth_along_surfaces(log_factor, log_depth, np.float32(config.feather / block), MAX_STEP)
    if len(curve):
        knots = np.log(curve)
        log_factor += np.interp(log_depth, knots[:, 0], knots[:, 1])
    factor = np.nan_to_num(np.exp(log_factor), nan=1.0).astype(np.float32)
    scale_depth(depth, cells, factor, block, out)


MAX_STEP = np.float32(0.03)  # of log depth from cell to cell, beyond which a surface ends
