"""Dense depth of one frame: census plane sweep over its neighbours, semi-global matching."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.sweep_kernels import (
    aggregate_paths,
    census_transform,
    choose_winners,
    fill_volume,
    raise_motion,
)
from laser_slam.sim3 import Array

BASELINES = (0.05, 0.10)  # of the neighbours, in median depths; wider ones lose to occlusion
MEDIAN_SIDE = 5  # pixels, of the filter over the winners

Float = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """One frame as the sweep wants it.

    Attributes:
        grey: (H, W) uint8 at the size of the depth map.
        census: (H, W) uint32 census transform of it.
        rotation: (3, 3) cam_from_window.
        translation: (3,) cam_from_window.
    """

    grey: NDArray[np.uint8]
    census: NDArray[np.uint32]
    rotation: Array
    translation: Array

    @property
    def centre(self) -> Array:
        """Return the camera centre in window axes."""
        return np.asarray(-self.rotation.T @ self.translation)


@dataclass(frozen=True)
class Sweep:
    """The winner of each pixel.

    Attributes:
        inverse_depth: (H, W), in 1 / window units.
        uniqueness: (H, W) how much better than the best plane elsewhere, in bits.
        cost: (H, W) matching cost of the winner, in bits.
        pixels_per_unit: (H, W) motion in the best neighbour per unit of inverse depth.
        is_far: (H, W) the winner is the farthest plane: sky or beyond range.
    """

    inverse_depth: Float
    uniqueness: Float
    cost: Float
    pixels_per_unit: Float
    is_far: NDArray[np.bool_]


def make_view(grey: NDArray[np.uint8], rotation: Array, translation: Array) -> View:
    """Prepare a frame for the sweep."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 0.6)
    return View(grey, census_transform(smooth), rotation, translation)


def choose_neighbours(
    views: list[View], frame: int, median_depth: float
) -> tuple[list[int], list[int]]:
    """Choose past and future views whose baselines come nearest to BASELINES."""
    centre = views[frame].centre
    baseline = np.array([np.linalg.norm(view.centre - centre) for view in views]) / median_depth
    sides = (range(frame - 1, -1, -1), range(frame + 1, len(views)))
    past, future = (_nearest(baseline, list(side)) for side in sides)
    return past, future


def _nearest(baseline: Array, side: list[int]) -> list[int]:
    chosen: list[int] = []
    for wanted in BASELINES:
        rest = [j for j in side if j not in chosen and baseline[j] > 0.25 * wanted]
        if rest:
            chosen.append(min(rest, key=lambda j: abs(float(baseline[j]) - wanted)))
    return chosen


def sweep(
    views: list[View], frame: int, neighbours: tuple[list[int], list[int]], planes: Float, K: Array
) -> Sweep:
    """Find the inverse depth of every pixel of a frame.

    Args:
        views: the frames of the window and its context.
        frame: which of them.
        neighbours: past and future views to compare with; at least one in all.
        planes: (D,) inverse depths, falling from near to far, in equal steps.
        K: (3, 3) intrinsics of the depth maps.
    """
    reference = views[frame]
    height, width = reference.census.shape
    volume = np.zeros((height, width, len(planes)), np.uint8)
    best_motion = np.zeros((height, width), np.float32)
    sides = [[_mapping(reference, views[j], K) for j in side] for side in neighbours]
    census = [
        np.stack([views[j].census for j in side]) if side else _no_view() for side in neighbours
    ]
    maps = [np.stack(side) if side else np.zeros((0, 3, 4)) for side in sides]
    fill_volume(reference.census, census[0], census[1], maps[0], maps[1], planes, volume)
    total = np.zeros(volume.shape, np.float32)
    aggregate_paths(volume, reference.grey, total)
    inverse_depth, uniqueness, cost, is_far = choose_winners(total, volume, planes)
    for mapping in [*sides[0], *sides[1]]:
        raise_motion(mapping, inverse_depth, best_motion)
    filtered = cv2.medianBlur(inverse_depth, MEDIAN_SIDE)
    return Sweep(filtered, uniqueness, cost, best_motion, is_far)


def _no_view() -> NDArray[np.uint32]:
    return np.zeros((0, 1, 1), np.uint32)


def _mapping(reference: View, other: View, K: Array) -> Array:
    """Return (3, 4): pixel (u, v, 1) and inverse depth to homogeneous pixel of the other view."""
    R = other.rotation @ reference.rotation.T
    t = other.translation - R @ reference.translation
    return np.column_stack([K @ R @ np.linalg.inv(K), K @ t])
