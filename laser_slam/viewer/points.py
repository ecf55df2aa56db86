"""Few points of a window that show it well, and few enough of all windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import FusionConfig
from laser_slam.types import Submap

Array = NDArray[np.float64]
Points = tuple[NDArray[np.float32], NDArray[np.uint8]]

_SPARES = 2  # times as many pixels are drawn as are needed, for those at edges


def sample_points(
    submap: Submap, rows: NDArray[np.int64], num: int, fusion: FusionConfig, unit: float
) -> Points:
    """Draw some of a window's points at random, but the same ones each time.

    Far pixels, which stand for larger surfaces, are drawn more often, by depth. Pixels stay out
    where the map leaves them out; at depth edges, where inverse depth, which is linear on a
    plane, bends.

    Args:
        submap: a window.
        rows: of the frames whose pixels are taken.
        num: points at most.
        fusion: what the map leaves out.
        unit: median depth of the window, in window units.

    Returns:
        Points (n, 3) in the window's frame and their colours (n, 3) RGB, in random order.
    """
    rng = np.random.default_rng(submap.index)
    depth = submap.prediction.depth[rows]
    usable = (depth > 0) & (depth <= fusion.max_range * unit)
    usable &= submap.prediction.confidence[rows] >= fusion.min_confidence
    usable[:, [0, -1]] = False
    usable[:, :, [0, -1]] = False
    pixels = np.flatnonzero(usable)
    # The smallest of exponential variates over weights: drawn without replacement, by weight.
    urgency = rng.standard_exponential(len(pixels), np.float32) / depth.ravel()[pixels]
    drawn = pixels[_smallest(urgency, _SPARES * num)]
    drawn = drawn[_is_smooth(depth, drawn, fusion.edge_jump)]
    chosen = np.unravel_index(rng.permutation(drawn)[:num], depth.shape)
    return _points_of(submap, rows[chosen[0]], chosen[1], chosen[2])


def _smallest(values: NDArray[np.float32], num: int) -> NDArray[np.int64]:
    if len(values) <= num:
        return np.arange(len(values))
    return np.argpartition(values, num)[:num]


def _is_smooth(
    depth: NDArray[np.float32], pixels: NDArray[np.int64], max_bend: float
) -> NDArray[np.bool_]:
    flat, width = depth.ravel(), depth.shape[2]
    smooth = np.ones(len(pixels), bool)
    for step in (1, width):
        before, here, after = flat[pixels - step], flat[pixels], flat[pixels + step]
        smooth &= np.abs(here / before + here / after - 2) <= max_bend  # unknown depth: no
    return smooth


def _points_of(
    submap: Submap, rows: NDArray[np.int64], v: NDArray[np.int64], u: NDArray[np.int64]
) -> Points:
    prediction = submap.prediction
    pixel = np.stack([u, v, np.ones(len(u))], axis=-1)
    cam_from_pixel = np.linalg.inv(prediction.intrinsics)[rows]
    rays = np.einsum("nij,nj->ni", cam_from_pixel, pixel)
    points = rays * prediction.depth[rows, v, u][:, None]
    window_from_cam = prediction.window_from_cam[rows]
    turned = np.einsum("nij,nj->ni", window_from_cam[:, :3, :3], points)
    in_window = turned + window_from_cam[:, :3, 3]
    return in_window.astype(np.float32), submap.colors[rows, v, u]


class PointBudget:
    """The points of all windows that are shown, never more than a limit at once.

    Where a window would exceed it, every second point of all windows goes, and later windows get
    half as many. So a long run keeps all its windows, ever thinner, and memory has a bound:
    15 bytes a point.

    Args:
        per_window: points of a window.
        limit: points of all windows.
    """

    def __init__(self, per_window: int, limit: int) -> None:
        self._limit = limit
        self._total = 0
        self._shown: dict[int, Points] = {}
        self.per_window = per_window

    def add(self, index: int, points: Points) -> dict[int, Points]:
        """Take the points of another window.

        Args:
            index: of the window.
            points: in random order, ``per_window`` at most, with their colours.

        Returns:
            The points of the windows whose points are to be drawn, anew perhaps.
        """
        self._shown[index] = points
        self._total += len(points[0])
        if self._total <= self._limit:
            return {index: points}
        while self._total > self._limit:
            self._halve()
        return dict(self._shown)

    def _halve(self) -> None:
        self.per_window = max(1, self.per_window // 2)
        self._shown = {
            index: (points[: len(points) // 2].copy(), colors[: len(points) // 2].copy())
            for index, (points, colors) in self._shown.items()
        }
        self._total = sum(len(points) for points, _ in self._shown.values())
