"""How far a depth can be trusted: geometry of the views, agreement between frames, matching."""

from __future__ import annotations

from itertools import islice

import cv2
import numpy as np
from numpy.linalg import norm
from numpy.typing import NDArray

from laser_slam.backbones.classical.confidence_kernels import ask
from laser_slam.backbones.classical.sweep import MEDIAN_SIDE, Float, Sweep, View
from laser_slam.sim3 import Array

MATCHING_PX = 0.35  # error of a match
TRUSTED_RELATIVE_ERROR = 0.08  # depth error at which the geometric confidence is one half
NUM_PARTNERS = 3  # frames that are asked on either side
MIN_BASELINE = 0.01  # to a partner, in median depths; from the same place, errors are the same too
UNIQUE_BITS = 48.0  # summed over four paths
WORST_COST, COST_RANGE = 11.0, 5.0  # bits


def confidence(
    views: list[View], sweeps: list[Sweep | None], frame: int, partners: list[int], K: Array
) -> Float:
    """Rate the depths of one frame against those of the frames around it.

    Args:
        views: frames in order.
        sweeps: one each; None: this frame was not swept.
        frame: which one to rate; it was swept.
        partners: the frames that are asked, as far as they were swept.
        K: (3, 3) intrinsics of the depth maps.

    Returns:
        (H, W) in [0, 1]; calibrated so that about 90 % of the pixels above 0.5 err by less
        than a tenth of their depth.
    """
    own = sweeps[frame]
    assert own is not None
    motion_px = np.maximum(own.pixels_per_unit * own.inverse_depth, 1e-6)
    geometry = 1.0 / (1.0 + (MATCHING_PX / motion_px / TRUSTED_RELATIVE_ERROR) ** 2)
    agree, asked = np.zeros_like(own.cost), np.zeros_like(own.cost)
    for partner in partners:
        other = sweeps[partner]
        if other is not None:
            mapping = relative_pose(views[frame], views[partner])
            ask(
                own.inverse_depth,
                own.pixels_per_unit,
                other.inverse_depth,
                mapping,
                K,
                agree,
                asked,
            )
    consistency = agree / np.maximum(asked, 2.0)
    unique = _smooth(np.clip(own.uniqueness / UNIQUE_BITS, 0, 1))
    match = _smooth(np.clip((WORST_COST - own.cost) / COST_RANGE, 0, 1))
    out = geometry * consistency**1.5 * np.sqrt(unique * match)
    out[_near_sky(own.is_far)] = 0
    return np.asarray(out, np.float32)


def choose_partners(views: list[View], frame: int, median_depth: float) -> list[int]:
    """Choose the next frames on either side that see a frame's scene from elsewhere."""
    centre = views[frame].centre
    sides = (range(frame - 1, -1, -1), range(frame + 1, len(views)))
    moved = (
        (j for j in side if norm(views[j].centre - centre) > MIN_BASELINE * median_depth)
        for side in sides
    )
    return [j for side in moved for j in islice(side, NUM_PARTNERS)]


def _near_sky(is_far: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Widen the sky by the matching patch: its colour clings to the edges of what is before it."""
    solid = cv2.medianBlur(is_far.astype(np.uint8), MEDIAN_SIDE)
    patch = np.ones((MEDIAN_SIDE, MEDIAN_SIDE), np.uint8)
    return np.asarray(is_far | (cv2.dilate(solid, patch) > 0))


def _smooth(values: Float) -> Float:
    """Average over the patch that the depth's median filter sees."""
    return np.asarray(cv2.blur(values, (MEDIAN_SIDE, MEDIAN_SIDE)))


def relative_pose(first: View, second: View) -> Array:
    """Return (3, 4) second_from_first."""
    R = second.rotation @ first.rotation.T
    return np.column_stack([R, second.translation - R @ first.translation])
