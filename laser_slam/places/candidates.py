"""Which keyframes may show a place seen before: few pairs, each of another pair of places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import PlacesConfig
from laser_slam.places.index import PlaceIndex
from laser_slam.places.similarity import SimilarityMap, map_similarities

Array32 = NDArray[np.float32]

BINS = 400  # of the histogram of similarities, over [-1, 1]
MIN_SPREAD = 0.02  # of unlike places; less was only ever seen of few of them
NORMAL_QUANTILE = 0.8413  # one standard deviation above the median


@dataclass(frozen=True)
class Place:
    """A keyframe as place recognition sees it.

    Attributes:
        frame: index in the sequence.
        window: that owns it.
        travelled: way since the start, in median depths: each step divided by the median depth
            of the scene there, so that a drifting unit of length makes no difference.
    """

    frame: int
    window: int
    travelled: float


@dataclass(frozen=True)
class Candidate:
    """Two keyframes that may show one place.

    Attributes:
        older: the earlier visit.
        newer: the later visit.
        similarity: cosine of their descriptors, the mean of the run removed.
        contrast: the same above the median of unlike pairs of the run, in their standard
            deviations.
    """

    older: Place
    newer: Place
    similarity: float
    contrast: float


class Background:
    """The similarities of all pairs compared so far: nearly all of them are of unlike places."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS, np.int64)

    def add(self, similarities: Array32) -> None:
        """Count (N,) similarities in [-1, 1]."""
        bins = np.clip((similarities + 1) * (BINS / 2), 0, BINS - 1).astype(np.int64)
        self._counts += np.bincount(bins, minlength=BINS)

    def contrast(self, similarities: Array32) -> Array32:
        """Say how many standard deviations (N,) similarities lie above the median."""
        shares = np.cumsum(self._counts) / max(1, self._counts.sum())
        middles = (np.arange(BINS) + 0.5) * (2 / BINS) - 1
        median, above = np.interp([0.5, NORMAL_QUANTILE], shares, middles)
        return np.asarray((similarities - median) / max(above - median, MIN_SPREAD), np.float32)


class CandidateSearch:
    """Compare each keyframe with all those that were left behind, and propose the best pairs.

    Memory: the descriptors, and about 200 bytes per keyframe.
    """

    def __init__(self, config: PlacesConfig, size: int) -> None:
        """Start with no place, for descriptors of length ``size``."""
        self._config = config
        self._index = PlaceIndex(size)
        self._background = Background()
        self._places: list[Place] = []
        self._travelled = np.zeros(0)
        self._proposed: list[Candidate] = []

    def add(self, places: Sequence[Place], descriptors: Array32) -> list[Candidate]:
        """Look for earlier visits of the next keyframes, then remember them.

        A pair stands for less similar ones near it at both ends, in the windows that follow, too.

        Args:
            places: M keyframes, in order, not compared with each other: those that one window
                owns, or fewer.
            descriptors: (M, D) of unit length, or zeros.

        Returns:
            Pairs of old and new keyframes, most similar first.

        Raises:
            ValueError: the way travelled falls or is not finite, or counts disagree.
        """
        if not len(places):
            return []
        travelled = np.array([place.travelled for place in places])
        if len(descriptors) != len(places):
            raise ValueError(f"{len(places)} places, {len(descriptors)} descriptors")
        steps = np.diff(np.concatenate([self._travelled[-1:], travelled]))
        if not (np.isfinite(travelled).all() and (steps >= 0).all()):
            raise ValueError("the way travelled must be finite and cannot fall")
        hits = self._hits(places, descriptors) if len(self._places) else []
        chosen = self._choose(sorted(hits, key=lambda hit: -hit.similarity))
        self._index.insert(descriptors)
        self._places += places
        self._travelled = np.concatenate([self._travelled, travelled])
        self._proposed = [hit for hit in [*self._proposed, *chosen] if self._is_near(hit, places)]
        return chosen

    def similarity_map(self) -> SimilarityMap:
        """Return how much all keyframes so far resemble each other."""
        frames = np.array([place.frame for place in self._places], np.int64)
        return map_similarities(self._index, frames)

    def _is_near(self, hit: Candidate, places: Sequence[Place]) -> bool:
        """Tell whether a pair may still stand for one of the keyframes that follow ``places``."""
        last = places[-1]
        way = last.travelled - hit.newer.travelled
        return hit.newer.window == last.window or way <= self._config.suppression

    def _hits(self, places: Sequence[Place], descriptors: Array32) -> list[Candidate]:
        """Find, for each new keyframe, the places that it resembles more than chance has it."""
        stops = [
            int(np.searchsorted(self._travelled, place.travelled - self._config.min_gap, "right"))
            for place in places
        ]
        found = self._index.similarities(descriptors, max(stops))
        rows = [row[:stop] for row, stop in zip(found, stops, strict=True)]
        for row in rows:
            self._background.add(row)
        return [
            hit for place, row in zip(places, rows, strict=True) for hit in self._peaks(place, row)
        ]

    def _peaks(self, newer: Place, similarities: Array32) -> list[Candidate]:
        """Return the best keyframe of each place that may be the one of ``newer``."""
        contrast = self._background.contrast(similarities)
        is_left = similarities >= self._config.min_similarity
        is_left &= contrast >= self._config.min_contrast
        peaks: list[Candidate] = []
        while is_left.any() and len(peaks) < self._config.max_per_keyframe:
            best = int(np.argmax(np.where(is_left, similarities, -np.inf)))
            older = self._places[best]
            peaks.append(Candidate(older, newer, float(similarities[best]), float(contrast[best])))
            way = np.abs(self._travelled[: len(is_left)] - older.travelled)
            is_left &= way > self._config.suppression
        return peaks

    def _choose(self, hits: Sequence[Candidate]) -> list[Candidate]:
        """Take hits, best first, that no better one of the same two places stands for."""
        taken = list(self._proposed)
        pairs = Counter((hit.older.window, hit.newer.window) for hit in taken)
        singles = Counter(hit.newer.window for hit in taken)
        chosen = []
        for hit in hits:
            windows = (hit.older.window, hit.newer.window)
            is_full = pairs[windows] >= self._config.max_per_window_pair
            is_full |= singles[hit.newer.window] >= self._config.max_per_window
            if not (is_full or any(self._stands_for(other, hit) for other in taken)):
                pairs[windows] += 1
                singles[hit.newer.window] += 1
                taken.append(hit)
                chosen.append(hit)
        return chosen

    def _stands_for(self, taken: Candidate, hit: Candidate) -> bool:
        """Tell whether a pair is as good as ``hit`` and near it at *both* ends.

        Near at one end only is another loop of a place that was seen more than twice.
        """
        radius = self._config.suppression
        return (
            taken.similarity >= hit.similarity
            and abs(taken.older.travelled - hit.older.travelled) <= radius
            and abs(taken.newer.travelled - hit.newer.travelled) <= radius
        )
