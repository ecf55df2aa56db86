"""Spread what an optimisation moved over the frames, so that none jumps at a window's border."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.sim3 import Sim3, interpolate_sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MovedWindow:
    """A window before and after an optimisation.

    Attributes:
        window_from_cam: (N, 4, 4) rigid, of the frames that it owns, in order; N may be 0.
        before: ``world_from_window`` as the registrations alone chain it, where neighbours agree.
        after: ``world_from_window`` as optimised.
    """

    window_from_cam: Array
    before: Sim3
    after: Sim3


def spread_corrections(windows: Sequence[MovedWindow]) -> list[list[Sim3]]:
    """Give each frame a ``world_from_window`` of its own, in place of its window's.

    The frame in the middle of a window moves as the window does. From there to the next window's
    middle the correction changes by an equal part at every frame; beyond the first and the last
    middle it is constant.

    Args:
        windows: in order of their frames.

    Returns:
        For each window one Sim(3) per owned frame.
    """
    knots = [row for row, window in enumerate(windows) if len(window.window_from_cam)]
    corrections = [windows[row].after @ windows[row].before.inverse() for row in knots]
    counts = np.array([len(windows[row].window_from_cam) for row in knots])
    starts = np.cumsum(counts) - counts
    middles = starts + (counts - 1) / 2
    moved = [[corrections[0]] * (int(np.floor(middles[0])) + 1)] if knots else []
    for left in range(len(knots) - 1):
        positions = np.arange(np.floor(middles[left]) + 1, np.floor(middles[left + 1]) + 1)
        shares = (positions - middles[left]) / (middles[left + 1] - middles[left])
        moved.append(interpolate_sim3(corrections[left], corrections[left + 1], shares))
    flat = [correction for part in moved for correction in part]
    flat += corrections[-1:] * (int(counts.sum()) - len(flat))
    out: list[list[Sim3]] = [[] for _ in windows]
    for row, start, count in zip(knots, starts, counts, strict=True):
        before = windows[row].before
        out[row] = [correction @ before for correction in flat[start : start + count]]
    return out


def spread_poses(windows: Sequence[MovedWindow]) -> Array:
    """Return the (M, 4, 4) rigid ``world_from_cam`` of all owned frames, corrections spread."""
    poses = [
        world_from_window.apply_poses(window_from_cam)
        for window, places in zip(windows, spread_corrections(windows), strict=True)
        for window_from_cam, world_from_window in zip(window.window_from_cam, places, strict=True)
    ]
    return np.array(poses).reshape(-1, 4, 4)
