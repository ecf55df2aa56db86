"""Depth and confidence of all frames of a window, over threads."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.confidence import choose_partners, confidence
from laser_slam.backbones.classical.sweep import (
    Float,
    Sweep,
    View,
    choose_neighbours,
    make_view,
    sweep,
)
from laser_slam.camera import resize_intrinsics
from laser_slam.config import ClassicalConfig
from laser_slam.sim3 import Array

NEAR, FAR, FAR_MEDIANS = 0.6, 3.0, 20.0  # range of the planes around the sparse depths
NEAREST_RATIO = 0.6  # of the first to the fifth percentile; below, the nearest points are false
MIN_SPARSE = 10  # points that tell a frame's range of depths
MIN_WITNESSES = 2  # frames that a frame's depth is compared with
KNOWN_CONFIDENCE = 0.02  # below it, depth is unknown


@dataclass(frozen=True)
class PosedFrames:
    """Frames with poses and the depths of their sparse points.

    Attributes:
        greys: C images (H, W) at full size.
        rotations: (C, 3, 3) cam_from_window.
        translations: (C, 3) cam_from_window.
        sparse_depths: C arrays of depths of the points that a frame sees, window units.
        intrinsics: (3, 3) in pixels of the images.
    """

    greys: Sequence[NDArray[np.uint8]]
    rotations: Array
    translations: Array
    sparse_depths: Sequence[Array]
    intrinsics: Array


def depth_size(size: tuple[int, int], width: int) -> tuple[int, int]:
    """Return the (height, width) of the depth maps of (height, width) images."""
    factor = min(1.0, width / size[1])
    return round(size[0] * factor), round(size[1] * factor)


def dense_depth(
    frames: PosedFrames, wanted: list[int], config: ClassicalConfig, workers: ThreadPoolExecutor
) -> tuple[Float, Float, Array]:
    """Compute the depth maps of some of the frames.

    Args:
        frames: the window and the frames around it, in order.
        wanted: which frames to compute.
        config: size and number of planes.
        workers: threads to share the frames among.

    Returns:
        (N, H, W) depth in window units, NaN: unknown; (N, H, W) confidence in [0, 1]; (3, 3)
        intrinsics of the depth maps.
    """
    full = frames.greys[0].shape
    size = depth_size((full[0], full[1]), config.depth_width)
    K = resize_intrinsics(frames.intrinsics, (full[0], full[1]), size)

    views = _make_views(frames, size, workers)
    medians = [float(np.median(d)) if len(d) >= MIN_SPARSE else 0.0 for d in frames.sparse_depths]
    partners = {i: choose_partners(views, i, medians[i]) for i in wanted if medians[i] > 0}
    sweeps: list[Sweep | None] = [None] * len(views)

    def find(frame: int) -> None:
        if medians[frame] > 0:
            known = frames.sparse_depths[frame]
            sweeps[frame] = _sweep_between(views, frame, known, config.num_planes, K)

    depth = np.full((len(wanted), *size), np.nan, np.float32)
    rating = np.zeros((len(wanted), *size), np.float32)

    def rate(frame: int) -> None:
        result, slot = sweeps[frame], wanted.index(frame)
        if result is not None:
            trust = confidence(views, sweeps, frame, partners[frame], K)
            is_known = (trust > KNOWN_CONFIDENCE) & (result.inverse_depth > 0)
            depth[slot][is_known] = 1.0 / result.inverse_depth[is_known]
            rating[slot][is_known] = trust[is_known]

    list(workers.map(find, _with_witnesses(partners)))
    list(workers.map(rate, partners))
    return depth, rating, K


def _make_views(
    frames: PosedFrames, size: tuple[int, int], workers: ThreadPoolExecutor
) -> list[View]:
    def view(frame: int) -> View:
        grey = cv2.resize(frames.greys[frame], size[::-1], interpolation=cv2.INTER_AREA)
        return make_view(grey, frames.rotations[frame], frames.translations[frame])

    return list(workers.map(view, range(len(frames.greys))))


def _sweep_between(
    views: list[View], frame: int, sparse_depths: Array, num_planes: int, K: Array
) -> Sweep | None:
    """Sweep a frame over the range of its sparse depths; None: no view is far enough from it."""
    neighbours = choose_neighbours(views, frame, float(np.median(sparse_depths)))
    if not neighbours[0] and not neighbours[1]:
        return None
    return sweep(views, frame, neighbours, plane_range(sparse_depths, num_planes), K)


def _with_witnesses(partners: dict[int, list[int]]) -> list[int]:
    """Return the frames to sweep: those to rate, and partners of those that have too few there."""
    out = set(partners)
    for asked in partners.values():
        if sum(frame in partners for frame in asked) < MIN_WITNESSES:
            out.update(asked)
    return sorted(out)


def plane_range(depths: Array, num: int) -> Float:
    """Return (num,) inverse depths in equal steps, the sparse depths well inside."""
    nearest, near_ones = np.percentile(depths, (1, 5))
    near = NEAR * max(float(nearest), NEAREST_RATIO * float(near_ones))
    far = min(FAR * float(np.percentile(depths, 99)), FAR_MEDIANS * float(np.median(depths)))
    return np.linspace(1.0 / near, 1.0 / max(far, 2 * near), num, dtype=np.float32)
