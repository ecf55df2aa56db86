"""A second pass over the layers, from the last window to the first.

Going forward, a window's layers know what the windows before said. Going backward, they learn
what the windows after say, so that early windows are as good as late ones and no seam remains
where the average was still young.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import LayersConfig
from laser_slam.layers.alignment import align_layers, first_layers
from laser_slam.layers.graph import first_rows
from laser_slam.types import Layers, Prediction

Array = NDArray[np.float64]

_KNOTS = 64


def smooth_layers(
    windows: Iterable[tuple[Prediction, Layers, float | None]], config: LayersConfig
) -> Iterator[Layers]:
    """Average what the windows before and after say of each layer.

    Args:
        windows: from the last to the first: a window as predicted, its layers as ``align_layers``
            gave them, and the scale of its registration to the window before; None: it is not
            measured.
        config: as for ``align_layers``.

    Yields:
        The layers of each window, in the same order.
    """
    after: tuple[Prediction, Layers] | None = None
    scale_after: float | None = None
    for prediction, forward, scale in windows:
        turned = _turned(prediction)
        labels = forward.labels[::-1]
        backward = first_layers(labels)
        if after is not None and scale_after is not None:
            backward, _ = align_layers(after, turned, labels, 1 / scale_after, config)
        yield _average(forward, _turned_layers(backward))
        after, scale_after = (turned, backward), scale


def _turned(prediction: Prediction) -> Prediction:
    """Let time run backwards."""
    return replace(
        prediction,
        frames=-prediction.frames[::-1],
        depth=prediction.depth[::-1],
        confidence=prediction.confidence[::-1],
        window_from_cam=prediction.window_from_cam[::-1],
        intrinsics=prediction.intrinsics[::-1],
    )


def _turned_layers(layers: Layers) -> Layers:
    """Let time run backwards."""
    labels = layers.labels[::-1]
    frames = range(len(labels) - 1, -1, -1)
    rows = np.concatenate(
        [np.arange(layers.starts[i], layers.starts[i + 1]) for i in frames]
    ).astype(np.int64)
    return Layers(
        labels, first_rows(labels), layers.scales[rows], layers.witnesses[rows], layers.curve
    )


def _average(forward: Layers, backward: Layers) -> Layers:
    """Join both directions; the window itself is in both, and counts once."""
    scales = _mean_log(
        (np.log(forward.scales), np.log(backward.scales)), (forward.witnesses, backward.witnesses)
    )
    return Layers(
        forward.labels,
        forward.starts,
        np.exp(scales),
        forward.witnesses + backward.witnesses - 1,
        _average_curve(forward, backward),
    )


def _average_curve(forward: Layers, backward: Layers) -> Array:
    depths = np.concatenate([forward.curve[:, 0], backward.curve[:, 0]])
    if not len(depths):
        return forward.curve
    knots = np.geomspace(depths.min(), depths.max(), _KNOTS)
    curves = _at(forward.curve, knots), _at(backward.curve, knots)
    heard = _witnesses_of_curve(forward), _witnesses_of_curve(backward)
    return np.stack([knots, np.exp(_mean_log(curves, heard))], axis=1)


def _at(curve: Array, knots: Array) -> Array:
    """Return the log factors of a curve at other depths."""
    if not len(curve):
        return np.zeros(len(knots))
    return np.asarray(np.interp(np.log(knots), *np.log(curve).T))


def _witnesses_of_curve(layers: Layers) -> Array:
    """Return how many windows stand behind a curve: as many as behind the layers it is made of."""
    heard = layers.witnesses[layers.witnesses > 1]
    return np.asarray(np.median(heard) if len(heard) else 1.0)


def _mean_log(values: tuple[Array, Array], heard: tuple[Array, Array]) -> Array:
    weighted = heard[0] * values[0] + heard[1] * values[1]
    return np.asarray(weighted / (heard[0] + heard[1] - 1))
