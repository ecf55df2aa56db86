"""By which factor the layers of a window differ from those of the window before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.layers.ratio_kernels import (
    BINS,
    REACH,
    first_to_reach,
    rising_mass,
    rising_mass_inside,
)

Array = NDArray[np.float64]
Float = NDArray[np.float32]
Indices = NDArray[np.int64]

_WIDTH = 2 * REACH / BINS  # of a bin
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
    weight = weight.astype(np.float32, copy=False)
    coarse = rising_mass(pairs.group, values, weight, pairs.num_groups)
    decisive, before, _ = _quantile(coarse, 0.5)
    fine = rising_mass_inside(pairs.group, values, weight, decisive)
    part = first_to_reach(fine, 0.5 * coarse[:, -1] - before)
    return np.asarray((decisive + (part + 0.5) / BINS) * _WIDTH - REACH)


def _quartile_distance(pairs: Pairs, values: Float) -> Array:
    """Return (G,) distance of the weighted quartiles, linear inside the bins of a histogram."""
    mass = rising_mass(pairs.group, values, pairs.weight, pairs.num_groups)
    first, third = (
        decisive + fraction
        for share in (0.25, 0.75)
        for decisive, _, fraction in [_quantile(mass, share)]
    )
    return np.asarray((third - first) * _WIDTH)


def _quantile(mass: Array, share: float) -> tuple[Indices, Array, Array]:
    """Return (G,) the bin that holds a quantile, the weight before it, and how far in it lies."""
    wanted = share * mass[:, -1]
    decisive: Indices = first_to_reach(mass, wanted)
    row = np.arange(len(mass))
    before = np.where(decisive > 0, mass[row, decisive - 1], 0.0)
    inside = np.maximum(mass[row, decisive] - before, 1e-30)
    return decisive, before, ((wanted - before) / inside).clip(0, 1)
