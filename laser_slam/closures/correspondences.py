"""Matched pixels with depth in both windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from laser_slam.closures.ends import End, PairMatches
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array

Rows = NDArray[np.int64]

_NEAR = 0.01  # of the known depth: nearer points are in the camera, and project anywhere
_EDGE = 1.15  # ratio of neighbouring depths beyond which a pixel lies on an edge


@dataclass(frozen=True)
class Views:
    """What one window knows of P matched points, each seen in one of its frames.

    Attributes:
        pixels: (P, 2).
        depth: (P,) z, in window units.
        focal: (P, 2) in pixels.
        center: (P, 2) principal point.
        window_from_cam: (P, 3, 4) rigid.
    """

    pixels: Array
    depth: Array
    focal: Array
    center: Array
    window_from_cam: Array

    def chosen(self, rows: NDArray[np.bool_] | Rows) -> Self:
        """Return some of the points."""
        return replace(self, **{name: value[rows] for name, value in vars(self).items()})

    @property
    def points_cam(self) -> Array:
        """Return (P, 3) the points in camera axes."""
        slopes = (self.pixels - self.center) / self.focal
        return np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) * self.depth[:, None]

    @property
    def points(self) -> Array:
        """Return (P, 3) the points in the window's axes."""
        return self._turn(self.points_cam) + self.window_from_cam[:, :, 3]

    def in_cam(self, points: Array) -> Array:
        """Return (P, 3) points of the window in the axes of each one's camera."""
        rotation, origin = self.window_from_cam[:, :, :3], self.window_from_cam[:, :, 3]
        return np.asarray(np.einsum("pji,pj->pi", rotation, points - origin))

    def misfit(self, points: Array) -> Array:
        """Compare (P, 3) points of the window with what was seen.

        Returns:
            (P, 3): projection less pixel, x and y, and log of depth over known depth; infinite
            behind the camera, or all but in it.
        """
        cam = self.in_cam(points)
        is_ahead = cam[:, 2] > _NEAR * self.depth
        z = np.where(is_ahead, cam[:, 2], 1.0)
        offset = self.focal * cam[:, :2] / z[:, None] + self.center - self.pixels
        out = np.concatenate([offset, np.log(z / self.depth)[:, None]], axis=1)
        out[~is_ahead] = np.inf
        return out

    def _turn(self, vectors: Array) -> Array:
        return np.asarray(np.einsum("pij,pj->pi", self.window_from_cam[:, :, :3], vectors))


@dataclass(frozen=True)
class Correspondences:
    """The same P points as two windows know them.

    Attributes:
        a: in window a.
        b: in window b.
        pair: (P,) which pair of images they come from.
        width: of the depth maps, in pixels.
        total: matches, with and without depth.
    """

    a: Views
    b: Views
    pair: Rows
    width: int
    total: int

    def __len__(self) -> int:
        return len(self.pair)

    def chosen(self, rows: NDArray[np.bool_] | Rows) -> Correspondences:
        """Return some of the points."""
        return replace(self, a=self.a.chosen(rows), b=self.b.chosen(rows), pair=self.pair[rows])


def correspond(a: End, b: End, pairs: Sequence[PairMatches]) -> Correspondences:
    """Collect the matches that have depth in both windows.

    Raises:
        DegenerateGeometryError: there is no match at all.
    """
    total = sum(len(pair.pixels_a) for pair in pairs)
    if total == 0:
        raise DegenerateGeometryError("the images have no matches")
    views_a = [_views(a, pair.in_a, pair.pixels_a) for pair in pairs]
    views_b = [_views(b, pair.in_b, pair.pixels_b) for pair in pairs]
    rows = np.repeat(np.arange(len(pairs)), [len(pair.pixels_a) for pair in pairs])
    joined_a, joined_b = _join(views_a), _join(views_b)
    width = a.prediction.depth.shape[2]
    everything = Correspondences(joined_a, joined_b, rows, width, total)
    return everything.chosen(np.isfinite(joined_a.depth) & np.isfinite(joined_b.depth))


def _views(end: End, index: int, pixels: Array) -> Views:
    prediction, num = end.prediction, len(pixels)
    K = prediction.intrinsics[index]
    known = np.where(prediction.confidence[index] > 0, prediction.depth[index], np.nan)
    return Views(
        np.asarray(pixels, dtype=np.float64),
        _depth_at(known, pixels),
        np.tile([K[0, 0], K[1, 1]], (num, 1)),
        np.tile([K[0, 2], K[1, 2]], (num, 1)),
        np.tile(prediction.window_from_cam[index, :3], (num, 1, 1)),
    )


def _join(views: Sequence[Views]) -> Views:
    columns = zip(*(vars(view).values() for view in views), strict=True)
    return Views(*(np.concatenate(parts) for parts in columns))


def _depth_at(depth: NDArray[np.float32], pixels: Array) -> Array:
    """Return (M,) depth between pixel centres, of surfaces only; NaN: unknown, or at an edge."""
    height, width = depth.shape
    floor = np.clip(np.floor(pixels), 0, [width - 2, height - 2]).astype(np.int64)
    share = pixels - floor
    x, y = floor.T
    corners = np.stack([depth[y, x], depth[y, x + 1], depth[y + 1, x], depth[y + 1, x + 1]])
    corners = corners.astype(np.float64)
    weights = np.stack(
        [
            (1 - share[:, 0]) * (1 - share[:, 1]),
            share[:, 0] * (1 - share[:, 1]),
            (1 - share[:, 0]) * share[:, 1],
            share[:, 0] * share[:, 1],
        ]
    )
    inverse = (weights / corners).sum(axis=0)  # of a plane, inverse depth is linear in the image
    is_surface = corners.max(axis=0) < _EDGE * corners.min(axis=0)
    is_inside = ((share >= -0.5) & (share <= 1.5)).all(axis=1)
    return np.where(is_surface & is_inside, 1 / np.where(inverse > 0, inverse, np.nan), np.nan)
