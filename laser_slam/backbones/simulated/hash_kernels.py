"""Random numbers that depend on a place and a seed only: the same wherever they are asked for."""

from __future__ import annotations

import numpy as np
from numba import njit

# uint64 throughout: mixed with a signed integer, numba would go on in float64
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST = np.uint64(0xBF58476D1CE4E5B9)
SECOND = np.uint64(0x94D049BB133111EB)
S30, S27, S31 = np.uint64(30), np.uint64(27), np.uint64(31)
LOW16 = np.uint64(0xFFFF)
STEPS16 = 65536.0
STD_OF_4_UNIFORM = np.sqrt(4.0 / 12.0)


@njit(cache=True, nogil=True, forceinline=True)
def mix(number: np.uint64, seed: np.uint64) -> np.uint64:
    """Scramble 64 bits: the finalizer of SplitMix64."""
    x = number * GOLDEN + seed
    x = (x ^ (x >> S30)) * FIRST
    x = (x ^ (x >> S27)) * SECOND
    return np.uint64(x ^ (x >> S31))


@njit(cache=True, nogil=True, forceinline=True)
def mix_cell(ix: int, iy: int, iz: int, seed: np.uint64) -> np.uint64:
    """Scramble the indices of a cell, of which 21 bits count."""
    mask = (1 << 21) - 1
    packed = (np.uint64(ix & mask) << np.uint64(42)) | (np.uint64(iy & mask) << np.uint64(21))
    return np.uint64(mix(packed | np.uint64(iz & mask), seed))


@njit(cache=True, nogil=True, forceinline=True)
def uniform(bits: np.uint64, part: int) -> float:
    """Return a number in (0, 1) from 16 of the 64 bits; ``part`` 0 to 3 says which."""
    return (float((bits >> np.uint64(16 * part)) & LOW16) + 0.5) / STEPS16


@njit(cache=True, nogil=True, forceinline=True)
def normal(bits: np.uint64) -> float:
    """Return a nearly normal number of variance 1: the sum of four uniform ones."""
    total = uniform(bits, 0) + uniform(bits, 1) + uniform(bits, 2) + uniform(bits, 3)
    return float((total - 2.0) / STD_OF_4_UNIFORM)
