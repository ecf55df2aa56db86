"""What of the measured ratios is distortion, and how it depends on depth: a Gaussian process.

The logarithm of a layer's factor is a curve over log depth plus a part of the layer's own, seen
through noise. How strong the three are, the ratios themselves say: where nothing is distorted,
both parts vanish and noise is not taken for a scale; where distortion follows depth, the curve
also says what to do with layers that no earlier window has seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_LENGTH = 1.0  # log depth over which the curve forgets itself
_MIN_SIGMA = 1e-3  # log-ratio below which nothing is worth a correction
_NOISE_SUPPORT = 60.0  # cells with which a layer's own noise counts as much as what all share
_STRENGTHS = (0.0, 0.2, 0.5, 1.0)  # of curve and layers, in spreads of the ratios
_MAX_OBSERVATIONS = 240


@dataclass(frozen=True)
class Observations:
    """What the shared frames say, pixels of one depth in one track of linked layers together.

    Attributes:
        log_ratio: (G,) by which the depth should grow.
        variance: (G,) noise of it.
        track: (G,) which track of layers; from 0.
        log_depth: (G,) in window units.
    """

    log_ratio: Array
    variance: Array
    track: Indices
    log_depth: Array


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
    spread = float(np.sqrt(np.mean(observed.log_ratio**2)))
    near = np.exp(-np.abs(observed.log_depth[:, None] - observed.log_depth) / _LENGTH)
    same = (observed.track[:, None] == observed.track).astype(float)
    noise = np.diag(observed.variance)
    best, chosen = -np.inf, (0.0, 0.0)
    for curve in _STRENGTHS if with_curve else (0.0,):
        for layer in _STRENGTHS:
            covariance = spread**2 * (curve**2 * near + layer**2 * same) + noise
            evidence = _evidence(covariance, observed.log_ratio)
            if evidence > best:
                best, chosen = evidence, (curve * spread, layer * spread)
    if max(chosen) < _MIN_SIGMA:
        return nothing
    covariance = chosen[0] ** 2 * near + chosen[1] ** 2 * same + noise
    pull = cho_solve(cho_factor(covariance), observed.log_ratio)
    of_track = chosen[1] ** 2 * np.bincount(observed.track, pull, minlength=num_tracks)
    knots = _knots(observed.log_depth) if chosen[0] else np.empty(0)
    curve_there = chosen[0] ** 2 * np.exp(-np.abs(knots[:, None] - observed.log_depth) / _LENGTH)
    return Distortion(knots, curve_there @ pull, np.asarray(of_track), chosen)


def _strongest(observed: Observations) -> Observations:
    """Keep no more observations than the algebra takes in a few milliseconds."""
    kept = np.sort(np.argsort(observed.variance, kind="stable")[:_MAX_OBSERVATIONS])
    return Observations(
        observed.log_ratio[kept],
        observed.variance[kept],
        observed.track[kept],
        observed.log_depth[kept],
    )


def _evidence(covariance: Array, values: Array) -> float:
    """Return the log-likelihood of (G,) values under a normal distribution, up to a constant."""
    factor = cho_factor(covariance, check_finite=False)
    spread = 2 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (values @ cho_solve(factor, values, check_finite=False) + spread))


def _knots(log_depth: Array) -> Array:
    low, high = float(log_depth.min()) - 0.5, float(log_depth.max()) + 0.5
    return np.linspace(low, high, 2 + int((high - low) / 0.1))
