"""By which factor the layers of a window differ from those of the window before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Float = NDArray[np.float32]
Indices = NDArray[np.int64]

_BINS = 256  # of the histograms; two rounds of them resolve 4e-5 of the log-ratio
_REACH = 1.4  # natural logarithm of the largest ratio that is told apart from larger ones
_MAX_ROUNDS = 100
_TOLERANCE = 1e-6  # relative
_HUBER_DELTA = 0.1  # in median depths of the group


@dataclass(frozen=True)
class Pairs:
    """Depths of the same pixels in two windows, each pixel in one group.

    Attributes:
        group: (P,) which group a pixel belongs to.
        source: (P,) depth in the current window, already scaled by its registration.
        target: (P,) depth in the window before, its own layers' scales applied.
        weight: (P,) trust.
        num_groups: groups in all.
    """

    group: Indices
    source: Float
    target: Float
    weight: Float
    num_groups: int


@dataclass(frozen=True)
class Ratios:
    """What each group of pixels says.

    Attributes:
        log_ratio: (G,) logarithm of the scale of the current window's depth; NaN: no pixels.
        spread: (G,) standard deviation of the pixels about it, from their quartiles.
        support: (G,) number of pixels.
    """

    log_ratio: Array
    spread: Array
    support: Indices


def measure_ratios(pairs: Pairs, estimator: str) -> Ratios:
    """Fit one scale to each group of pixels, all groups at once.

    Args:
        pairs: the pixels.
        estimator: one of ``RATIO_ESTIMATORS``.
    """
    support = np.bincount(pairs.group, minlength=pairs.num_groups)
    log_ratio = np.log(pairs.target) - np.log(pairs.source)
    quartiles = [
        _weighted_quantile(pairs, log_ratio, pairs.weight, share) for share in (0.25, 0.75)
    ]
    scale = RATIO_ESTIMATORS[estimator](pairs, log_ratio)
    return Ratios(
        np.where(support > 0, scale, np.nan), (quartiles[1] - quartiles[0]) / 1.349, support
    )


def _median(pairs: Pairs, log_ratio: Float) -> Array:
    """Median of the log-ratios: no unit, no leverage of far pixels."""
    return _weighted_quantile(pairs, log_ratio, pairs.weight, 0.5)


def _l1(pairs: Pairs, log_ratio: Float) -> Array:
    """Minimum of the sum of ``|s * source - target|``, which is a weighted median of the ratios."""
    return _weighted_quantile(pairs, log_ratio, pairs.weight * pairs.source, 0.5)


def _huber(pairs: Pairs, log_ratio: Float) -> Array:
    """Huber on ``|s * source - target|``, the paper's, run until it converges."""
    scale = np.exp(_median(pairs, log_ratio))
    totals = _sums(pairs, pairs.target) / np.maximum(_sums(pairs, np.ones_like(pairs.target)), 1)
    bend = _HUBER_DELTA * totals[pairs.group]
    for _round in range(_MAX_ROUNDS):
        errors = np.abs(scale[pairs.group] * pairs.source - pairs.target)
        last, scale = scale, _least_squares(pairs, bend / np.maximum(errors, bend))
        if (np.abs(scale - last) <= _TOLERANCE * last).all():
            break
    return np.asarray(np.log(scale))


def _closed_form(pairs: Pairs, _: Float) -> Array:
    """Least squares, without reweighting."""
    return np.asarray(np.log(_least_squares(pairs, np.ones_like(pairs.source))))


RATIO_ESTIMATORS: dict[str, Callable[[Pairs, Float], Array]] = {
    "median": _median,
    "huber": _huber,
    "l1": _l1,
    "closed_form": _closed_form,
}


def _least_squares(pairs: Pairs, weight: NDArray[Any]) -> Array:
    weighted = weight * pairs.source
    below = _sums(pairs, weighted * pairs.source)
    return np.where(below > 0, _sums(pairs, weighted * pairs.target), 1.0) / np.where(
        below > 0, below, 1.0
    )


def _sums(pairs: Pairs, values: NDArray[Any]) -> Array:
    return np.asarray(np.bincount(pairs.group, values, minlength=pairs.num_groups), np.float64)


def _weighted_quantile(pairs: Pairs, values: Float, weight: Float, share: float) -> Array:
    """Return (G,) weighted quantiles of each group: a histogram, then one of its decisive bin."""
    low = np.full(pairs.num_groups, -_REACH)
    width = 2 * _REACH / _BINS
    below = np.zeros(pairs.num_groups)
    inside = np.ones(len(values), dtype=bool)
    total = _sums(pairs, weight)
    for last in (False, True):
        position = (values - low[pairs.group]) / width
        if not last:
            position = position.clip(0, _BINS - 1e-3)
        else:
            inside = (position >= 0) & (position < _BINS)
        cell = pairs.group[inside] * _BINS + position[inside].astype(np.int64)
        counts = np.bincount(cell, weight[inside], minlength=pairs.num_groups * _BINS)
        mass = below[:, None] + counts.reshape(-1, _BINS).cumsum(axis=1)
        decisive = (mass < share * total[:, None]).sum(axis=1).clip(0, _BINS - 1)
        before = np.where(decisive > 0, mass[np.arange(len(mass)), decisive - 1], below)
        low, below = low + decisive * width, before
        width /= _BINS
    return np.asarray(low + 0.5 * width * _BINS)
