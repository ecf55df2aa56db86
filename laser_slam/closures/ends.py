"""The two ends of a candidate, and what of one image is where in the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import ClosuresConfig, VerificationConfig
from laser_slam.places import Verification, find_features, verify
from laser_slam.sim3 import Array
from laser_slam.types import Image, Prediction

# (H, W, 3) RGB of one end and the other, (3, 3) intrinsics of the first -> what their geometry says
Matcher = Callable[[Image, Image, Array], Verification]


@dataclass(frozen=True)
class End:
    """One end of a candidate: a window that saw the place.

    Attributes:
        window: its index.
        prediction: layers applied, in window units.
        colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.
        matched: which of the N frames was taken for the place.
    """

    window: int
    prediction: Prediction
    colors: Image
    matched: int

    @property
    def frame(self) -> int:
        """Return the index, in the sequence, of the frame that was taken for the place."""
        return int(self.prediction.frames[self.matched])

    @cached_property
    def median_depth(self) -> float:
        """Return the median of the known depths near the matched frame, in window units; or NaN."""
        near = self.prediction.depth[max(0, self.matched - 2) : self.matched + 3, ::2, ::2]
        known = near[near > 0]
        return float(np.median(known)) if known.size else float("nan")


@dataclass(frozen=True)
class PairMatches:
    """Pixels of two images that show the same points; some may be wrong.

    Attributes:
        in_a: which frame of window a.
        in_b: which frame of window b.
        pixels_a: (M, 2) x, y in pixels of a's depth maps.
        pixels_b: (M, 2) the same points in b's.
    """

    in_a: int
    in_b: int
    pixels_a: Array
    pixels_b: Array


def make_matcher(config: VerificationConfig) -> Matcher:
    """Match features and keep those that agree on one motion of the camera."""

    def match(first: Image, second: Image, intrinsics: Array) -> Verification:
        features = find_features(first, config), find_features(second, config)
        return verify(*features, intrinsics, config)

    return match


def match_ends(
    a: End, b: End, matcher: Matcher, config: ClosuresConfig
) -> tuple[Verification, list[PairMatches]]:
    """Match the frames that were taken for one place, and their neighbours where these match too.

    Returns:
        What the images of the two frames say, and the pairs that match, theirs first; none where
        theirs do not.
    """
    first = _verify(a, b, 0, matcher)
    if first.rejected:
        return first, []
    reach = np.arange(1, config.neighbours + 1) * config.neighbour_step
    pairs = [_pair(a, b, 0, first)]
    for step in (int(step) for step in (*reach, *-reach)):
        if 0 <= a.matched + step < len(a.colors) and 0 <= b.matched + step < len(b.colors):
            found = _verify(a, b, step, matcher)
            pairs += [] if found.rejected else [_pair(a, b, step, found)]
    return first, pairs


def _verify(a: End, b: End, step: int, matcher: Matcher) -> Verification:
    i, j = a.matched + step, b.matched + step
    return matcher(a.colors[i], b.colors[j], a.prediction.intrinsics[i])


def _pair(a: End, b: End, step: int, found: Verification) -> PairMatches:
    return PairMatches(a.matched + step, b.matched + step, found.first_pixels, found.second_pixels)


def frames_around(end: End, num: int) -> NDArray[np.int64]:
    """Return up to ``num`` rising positions in the window, the matched frame in their middle.

    At the border of the window the range shifts, so that there are still ``num`` if it has them.
    """
    total = len(end.prediction.frames)
    first = min(max(0, end.matched - num // 2), max(0, total - num))
    return np.arange(first, min(first + num, total))
