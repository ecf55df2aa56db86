"""Compiled loops over the pixels of groups: histograms and sums."""

from __future__ import annotations

import numpy as np
from numba import njit

BINS = 256  # of the histograms; two rounds of them resolve 4e-5 of the log-ratio
REACH = 1.4  # natural logarithm of the largest ratio that is told apart from larger ones
_REACH, _PER_UNIT = np.float32(REACH), np.float32(BINS / (2 * REACH))
_LAST, _BINS, _ZERO = np.float32(BINS - 1e-3), np.float32(BINS), np.float32(0)


@njit(cache=True, nogil=True, inline="always")
def _position(value):
    """Return bin and place in it of a float32 value; what is out of reach is at the end."""
    return min(max((value + _REACH) * _PER_UNIT, _ZERO), _LAST)


@njit(cache=True, nogil=True)
def rising_mass(group, values, weight, num_groups):
    """Return (G, BINS) float64 weight of all values up to the end of each bin.

    Args:
        group: (P,) which group a value belongs to.
        values: (P,) float32.
        weight: (P,) float32.
        num_groups: groups in all.
    """
    mass = np.zeros((num_groups, BINS), np.float64)
    for p in range(group.size):
        mass[group[p], np.int64(_position(values[p]))] += weight[p]
    return _cumulated(mass)


@njit(cache=True, nogil=True)
def rising_mass_inside(group, values, weight, decisive):
    """Return (G, BINS) the same for the parts of one bin of each group.

    Args:
        group: (P,).
        values: (P,) float32.
        weight: (P,) float32.
        decisive: (G,) which bin.
    """
    mass = np.zeros((decisive.size, BINS), np.float64)
    for p in range(group.size):
        # The same rounding as in the first round: no value may fall between two bins.
        fine = (_position(values[p]) - np.float32(decisive[group[p]])) * _BINS
        # No branch, which would be guessed wrong: what is outside adds 0 to any bin.
        inside = (fine >= _ZERO) & (fine < _BINS)
        mass[group[p], np.int64(fine) & (BINS - 1)] += weight[p] if inside else _ZERO
    return _cumulated(mass)


@njit(cache=True, nogil=True)
def _cumulated(mass):
    for g in range(mass.shape[0]):
        for b in range(1, mass.shape[1]):
            mass[g, b] += mass[g, b - 1]
    return mass


@njit(cache=True, nogil=True)
def first_to_reach(mass, wanted):
    """Return (G,) the first bin where (G, B) rising ``mass`` reaches (G,) ``wanted``."""
    out = np.empty(wanted.size, np.int64)
    for g in range(wanted.size):
        out[g] = min(np.searchsorted(mass[g], wanted[g]), mass.shape[1] - 1)
    return out


@njit(cache=True, nogil=True)
def sum_by_group(group, place, width, values, num_groups):
    """Return (3, G) sums of values, of columns and of rows.

    Args:
        group: (P,).
        place: (P,) index of the pixel in (h, w) images.
        width: w.
        values: (P,) float32.
        num_groups: groups in all.
    """
    out = np.zeros((3, num_groups), np.float64)
    for p in range(group.size):
        g, v = group[p], place[p] // width
        out[0, g] += values[p]
        out[1, g] += place[p] - v * width
        out[2, g] += v
    return out
