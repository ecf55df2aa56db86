"""All places of a run: one matrix that grows, and products with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

FIRST_CAPACITY = 256
BLOCK = 4096  # places that are widened to float32 at a time
PRIOR = 32  # places at the origin that the mean starts from: a few alike are not the mean
MIN_SQUARED = 1e-6  # length from which a centred descriptor has a direction


class PlaceIndex:
    """Find what a descriptor resembles among those inserted so far.

    Similarity is the cosine after the mean of all inserted descriptors is taken off, which is
    what every image of the run has in common. 1: the same; about 0: as any two places; exactly
    0: one of them is blank. Held in float16: 4 KB per place and 400 MB per 100,000 places for
    2048 numbers; rounding moves a similarity by less than 0.001.
    """

    def __init__(self, size: int) -> None:
        """Start empty, for descriptors of length ``size``."""
        self._rows = np.zeros((FIRST_CAPACITY, size), np.float16)
        self._is_seen = np.zeros(FIRST_CAPACITY, np.bool_)  # not blank
        self._num = 0
        self._sum = np.zeros(size, np.float64)

    def __len__(self) -> int:
        """Return the number of descriptors inserted."""
        return self._num

    def insert(self, descriptors: Array32) -> None:
        """Append (M, D) descriptors; each is of unit length, or zeros."""
        end = self._num + len(descriptors)
        while end > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
            self._is_seen = np.concatenate([self._is_seen, np.zeros_like(self._is_seen)])
        self._rows[self._num : end] = descriptors
        self._is_seen[self._num : end] = np.any(descriptors != 0, axis=1)
        self._num = end
        self._sum += descriptors.sum(axis=0, dtype=np.float64)

    def descriptors(self, positions: NDArray[np.int64]) -> Array32:
        """Return (M, D) of what was inserted, by its position."""
        return self._rows[positions].astype(np.float32)

    def similarities(self, descriptors: Array32, stop: int | None = None) -> Array32:
        """Compare (M, D) descriptors with the first ``stop`` inserted, None: all; (M, stop)."""
        stop = self._num if stop is None else min(stop, self._num)
        mean = (self._sum / (self._is_seen.sum() + PRIOR)).astype(np.float32)
        probes = np.vstack([_centred(descriptors, mean), mean])
        out = np.zeros((len(descriptors), stop), np.float32)
        squared_mean = float(mean @ mean)
        for start in range(0, stop, BLOCK):
            block = slice(start, min(start + BLOCK, stop))
            rows = self._rows[block].astype(np.float32)
            products = probes @ rows.T
            # |x - m|^2 for unit x; the probes are centred, so that q.(x - m) = q.x - q.m
            squared = 1 - 2 * products[-1] + squared_mean
            dots = products[:-1] - (probes[:-1] @ mean)[:, None]
            is_seen = (squared > MIN_SQUARED) & self._is_seen[block]
            cosines = dots / np.sqrt(np.where(is_seen, squared, 1))
            out[:, block] = np.where(is_seen, cosines, 0)
        return out

    def query(
        self, descriptor: Array32, k: int, stop: int | None = None
    ) -> tuple[NDArray[np.int64], Array32]:
        """Return the positions and similarities of the k most similar, best first.

        Args:
            descriptor: (D,) of unit length, or zeros.
            k: how many; fewer come back where there are not as many.
            stop: only the first so many inserted may be found; None: all.
        """
        found = self.similarities(descriptor[None], stop)[0]
        best = np.argsort(-found, kind="stable")[:k]
        return best, found[best]


def _centred(descriptors: Array32, mean: Array32) -> Array32:
    """Take the mean off (M, D) descriptors and scale them to unit length; blank ones are zeros."""
    out = descriptors - mean
    length = np.linalg.norm(out, axis=1, keepdims=True)
    is_seen = np.any(descriptors != 0, axis=1, keepdims=True) & (length**2 > MIN_SQUARED)
    return np.asarray(np.where(is_seen, out / np.where(is_seen, length, 1), 0), np.float32)
