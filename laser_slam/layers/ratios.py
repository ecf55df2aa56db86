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
    scale = RATIO_ESTIMATORS[estimator](pairs, log_ratio)
    spread = _quartile_distance(pairs, log_ratio) / 1.349
    return Ratios(np.where(support > 0, scale, np.nan), spread, support)


def _median(pairs: Pairs, log_ratio: Float) -> Array:
    """Median of the log-ratios: no unit, no leverage of far pixels."""
    return _median_of(pairs, log_ratio, pairs.weight)


def _l1(pairs: Pairs, log_ratio: Float) -> Array:
    """Minimum of the sum of ``|s * source - target|``, which is a weighted median of the ratios."""
    return _median_of(pairs, log_ratio, pairs.weight * pairs.source)


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


def _median_of(pairs: Pairs, values: Float, weight: Float) -> Array:
    """Return (G,) weighted medians: a histogram of each group, then one of its decisive bin."""
    width = 2 * _REACH / _BINS
    decisive, before, _ = _decisive_bins(pairs, values, weight, 0.5)
    # The same rounding as in the first round: no value may fall between two bins.
    fine = (_positions(values) - decisive.astype(np.float32)[pairs.group]) * _BINS
    inside = (fine >= 0) & (fine < _BINS)
    counts = _histogram(pairs, fine[inside], inside, weight)
    mass = before[:, None] + counts.cumsum(axis=1)
    half = 0.5 * _sums(pairs, weight)
    low = decisive * width - _REACH
    return np.asarray(low + (_rank(mass, half) + 0.5) * width / _BINS)


def _quartile_distance(pairs: Pairs, values: Float) -> Array:
    """Return (G,) distance of the weighted quartiles, linear inside the bins of a histogram."""
    first, third = (
        decisive + fraction
        for share in (0.25, 0.75)
        for decisive, _, fraction in [_decisive_bins(pairs, values, pairs.weight, share)]
    )
    return np.asarray((third - first) * 2 * _REACH / _BINS)


def _decisive_bins(
    pairs: Pairs, values: Float, weight: Float, share: float
) -> tuple[Array, Array, Array]:
    """Return (G,) the bin that holds a quantile, the weight before it, and how far in it lies."""
    position = _positions(values)
    mass = _histogram(pairs, position, np.ones(len(values), dtype=bool), weight).cumsum(axis=1)
    wanted = share * mass[:, -1]
    decisive = _rank(mass, wanted)
    row = np.arange(len(mass))
    before = np.where(decisive > 0, mass[row, decisive - 1], 0.0)
    inside = np.maximum(mass[row, decisive] - before, 1e-30)
    return decisive.astype(np.float64), before, ((wanted - before) / inside).clip(0, 1)


def _positions(values: Float) -> Float:
    """Return (P,) bin and place in it of each value; what is out of reach is at the end."""
    position = (values + _REACH) * (_BINS / (2 * _REACH))
    return np.asarray(position.clip(0, _BINS - 1e-3), np.float32)


def _histogram(
    pairs: Pairs, position: NDArray[Any], used: NDArray[np.bool_], weight: Float
) -> Array:
    cell = pairs.group[used] * _BINS + position.astype(np.int64)
    counts = np.bincount(cell, weight[used], minlength=pairs.num_groups * _BINS)
    return np.asarray(counts.reshape(-1, _BINS), np.float64)


def _rank(mass: Array, wanted: Array) -> Indices:
    """Return (G,) the first bin where (G, B) rising ``mass`` reaches ``wanted``."""
    return np.asarray((mass < wanted[:, None]).sum(axis=1).clip(0, mass.shape[1] - 1), np.int64)
