"""What of the measured ratios is distortion, and how it depends on depth: a Gaussian process.

The logarithm of a layer's factor is a curve over log depth plus a part of the layer's own, seen
through noise. How strong the three are, the ratios themselves say: where nothing is distorted,
both parts vanish and noise is not taken for a scale; where distortion follows depth, the curve
also says what to do with layers that no earlier window has seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from threadpoolctl import ThreadpoolController

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_LENGTH = 1.0  # log depth over which the curve forgets itself
_MIN_SIGMA = 1e-3  # log-ratio below which nothing is worth a correction
_STRENGTHS = (0.0, 0.3, 0.7, 1.2)  # of curve and layers, in spreads of the ratios
_MARGIN = 2.0  # of log evidence that a part must bring: noise alone brings a little every time
_MAX_OBSERVATIONS = 240
_NEIGHBOURHOOD = 0.15  # image widths over which neighbours cease to be parts of one thing
_SURFACE = 0.6  # of log depth, the same


@dataclass(frozen=True)
class Observations:
    """What the shared frames say, pixels of one depth in one track of linked layers together.

    Attributes:
        log_ratio: (G,) by which the depth should grow.
        variance: (G,) noise of it.
        track: (G,) which track of layers; from 0.
        log_depth: (G,) in window units.
        place: (G, 2) centre in the image, in image widths.
    """

    log_ratio: Array
    variance: Array
    track: Indices
    log_depth: Array
    place: Array


@dataclass(frozen=True)
class Distortion:
    """What the observations are explained by.

    Attributes:
        knots: (K,) log depth, rising; empty: no curve.
        curve: (K,) log factor there.
        of_track: (T,) log factor of each track's own.
        strengths: standard deviation of curve and of the tracks' own parts.
    """

    knots: Array
    curve: Array
    of_track: Array
    strengths: tuple[float, float]


NO_DISTORTION = Distortion(np.empty(0), np.empty(0), np.empty(0), (0.0, 0.0))


def explain(observed: Observations, num_tracks: int, *, with_curve: bool) -> Distortion:
    """Split the observations into curve, tracks' own parts and noise by their evidence.

    Args:
        observed: the observations; none: nothing is distorted.
        num_tracks: tracks in all.
        with_curve: False: layers only.

    Reference: Rasmussen and Williams, Gaussian Processes for Machine Learning, eq. 2.23-2.30.
    """
    observed = _strongest(observed)
    nothing = Distortion(np.empty(0), np.empty(0), np.zeros(num_tracks), (0.0, 0.0))
    if len(observed.log_ratio) < 2:
        return nothing
    # Matrices this small are solved before a second thread has woken up to wait for its part.
    with _thread_pools().limit(limits=1, user_api="blas"):
        distortion = _explain(observed, num_tracks, _STRENGTHS if with_curve else (0.0,))
    return distortion or nothing


@cache
def _thread_pools() -> ThreadpoolController:
    return ThreadpoolController()


def _explain(
    observed: Observations, num_tracks: int, curves: tuple[float, ...]
) -> Distortion | None:
    near, same = _alike(observed)
    chosen = _likeliest(near, same, observed, curves)
    if max(chosen) < _MIN_SIGMA:
        return None
    covariance = chosen[0] ** 2 * near + chosen[1] ** 2 * same + np.diag(observed.variance)
    pull = cho_solve(cho_factor(covariance), observed.log_ratio)
    own = chosen[1] ** 2 * same @ pull
    of_track = _means(own, observed, num_tracks)
    knots = _knots(observed.log_depth) if chosen[0] else np.empty(0)
    curve_there = chosen[0] ** 2 * np.exp(-np.abs(knots[:, None] - observed.log_depth) / _LENGTH)
    return Distortion(knots, curve_there @ pull, np.asarray(of_track), chosen)


def _alike(observed: Observations) -> tuple[Array, Array]:
    """Return (G, G) how alike curve and tracks' own parts are for each two observations."""
    step = np.abs(observed.log_depth[:, None] - observed.log_depth)
    apart = sum(np.abs(axis[:, None] - axis) for axis in observed.place.T)
    same = 0.5 * (observed.track[:, None] == observed.track)
    same += 0.5 * np.exp(-apart / _NEIGHBOURHOOD - step / _SURFACE)
    return np.exp(-step / _LENGTH), same


def _likeliest(
    near: Array, same: Array, observed: Observations, curves: tuple[float, ...]
) -> tuple[float, float]:
    """Return the standard deviations of curve and tracks' own parts with the most evidence."""
    spread = float(np.sqrt(np.mean(observed.log_ratio**2)))
    own = [(spread * layer) ** 2 * same for layer in _STRENGTHS]
    best, chosen = -np.inf, (0.0, 0.0)
    for curve in curves:
        others = (spread * curve) ** 2 * near + np.diag(observed.variance)
        for layer, part in zip(_STRENGTHS, own, strict=True):
            evidence = _evidence(others + part, observed.log_ratio)
            evidence -= _MARGIN * ((curve > 0) + (layer > 0))
            if evidence > best:
                best, chosen = evidence, (curve * spread, layer * spread)
    return chosen


def _strongest(observed: Observations) -> Observations:
    """Keep no more observations than the algebra takes in a few milliseconds."""
    kept = np.sort(np.argsort(observed.variance, kind="stable")[:_MAX_OBSERVATIONS])
    return Observations(
        observed.log_ratio[kept],
        observed.variance[kept],
        observed.track[kept],
        observed.log_depth[kept],
        observed.place[kept],
    )


def _means(values: Array, observed: Observations, num_tracks: int) -> Array:
    """Average (G,) values over each track, by their certainty; 0 for tracks without any."""
    certainty = 1 / observed.variance
    sums = np.bincount(observed.track, certainty * values, minlength=num_tracks)
    weights = np.bincount(observed.track, certainty, minlength=num_tracks)
    return np.asarray(sums / np.maximum(weights, 1e-30))


def _evidence(covariance: Array, values: Array) -> float:
    """Return the log-likelihood of (G,) values under a normal distribution, up to a constant.

    The covariance is overwritten.
    """
    factor = cho_factor(covariance.T, overwrite_a=True, check_finite=False)
    spread = 2 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (values @ cho_solve(factor, values, check_finite=False) + spread))


def _knots(log_depth: Array) -> Array:
    low, high = float(log_depth.min()) - 0.5, float(log_depth.max()) + 0.5
    return np.linspace(low, high, 2 + int((high - low) / 0.1))
