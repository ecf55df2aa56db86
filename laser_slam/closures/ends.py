"""The two ends of a candidate, and what of one image is where in the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import ClosuresConfig, VerificationConfig
from laser_slam.places import find_features, verify
from laser_slam.sim3 import Array
from laser_slam.types import Image, Prediction

# (H, W, 3) RGB of one end and the other, (3, 3) intrinsics of the first -> (M, 2) and (M, 2) pixels
# of the same points; none where the images do not show one place.
Matcher = Callable[[Image, Image, Array], tuple[Array, Array]]


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

    def match(first: Image, second: Image, intrinsics: Array) -> tuple[Array, Array]:
        found = verify(
            find_features(first, config), find_features(second, config), intrinsics, config
        )
        if found.rejected:
            return np.zeros((0, 2)), np.zeros((0, 2))
        return found.first_pixels, found.second_pixels

    return match


def match_ends(a: End, b: End, matcher: Matcher, config: ClosuresConfig) -> list[PairMatches]:
    """Match the frames that were taken for one place, and their neighbours where these match too.

    Returns:
        The matched pair first; empty if it does not match.
    """
    reach = np.arange(1, config.neighbours + 1) * config.neighbour_step
    pairs = []
    for step in (0, *reach, *-reach):
        i, j = a.matched + int(step), b.matched + int(step)
        if not (0 <= i < len(a.colors) and 0 <= j < len(b.colors)):
            continue
        pixels_a, pixels_b = matcher(a.colors[i], b.colors[j], a.prediction.intrinsics[i])
        if len(pixels_a):
            pairs.append(PairMatches(i, j, pixels_a, pixels_b))
        elif step == 0:
            break
    return pairs


def frames_around(end: End, num: int) -> NDArray[np.int64]:
    """Return up to ``num`` rising positions in the window, the matched frame in their middle.

    At the border of the window the range shifts, so that there are still ``num`` if it has them.
    """
    total = len(end.prediction.frames)
    first = min(max(0, end.matched - num // 2), max(0, total - num))
    return np.arange(first, min(first + num, total))
