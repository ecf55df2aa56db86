"""What other frames of a window say of a pixel: they agree, see through it, or see neither."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.config import FusionConfig
from laser_slam.types import Prediction

Array = NDArray[np.float64]

_STEPS = (-4, -2, -1, 1, 2, 4)  # to the frames that are asked


class _Others(NamedTuple):
    """The frames that are asked.

    Attributes:
        depth: (K, H, W) in window units; NaN: unknown or not confident.
        from_ray: (K, 3, 3) maps (u, v, 1) times depth to pixels times depth of the other frame.
        shift: (K, 3) to be added.
    """

    depth: NDArray[np.float32]
    from_ray: Array
    shift: Array


def consistent_depth(
    prediction: Prediction, row: int, weight: NDArray[np.float32], config: FusionConfig
) -> NDArray[np.float32]:
    """Average a frame's depth with what the frames around it in its window say of each pixel.

    A pixel that too few of them agree with, or that more of them see through, gets the weight 0:
    noise, veils behind edges, and whatever moved.

    Args:
        prediction: of the window.
        row: of the frame.
        weight: (H, W) of the frame's pixels, changed in place.
        config: tolerance and how many must agree.

    Returns:
        (H, W) depth in window units.
    """
    depth = np.ascontiguousarray(prediction.depth[row], np.float32)
    if not config.agreement:
        return depth
    rows = [row + step for step in _STEPS if 0 <= row + step < len(prediction.frames)]
    others = _others(prediction, row, rows, config.min_confidence)
    out = depth.copy()
    _ask(depth, others, (config.agreement, min(config.min_agreeing, len(rows))), weight, out)
    return out


def _others(prediction: Prediction, row: int, rows: list[int], least: float) -> _Others:
    K_inverse = np.linalg.inv(prediction.intrinsics[row])
    other_from_window = np.linalg.inv(prediction.window_from_cam[rows])
    other_from_cam = other_from_window @ prediction.window_from_cam[row]
    K = prediction.intrinsics[rows]
    is_known = prediction.confidence[rows] >= least
    return _Others(
        np.where(is_known, prediction.depth[rows], np.float32(np.nan)),
        np.ascontiguousarray(K @ other_from_cam[:, :3, :3] @ K_inverse),
        np.ascontiguousarray((K @ other_from_cam[:, :3, 3:])[..., 0]),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _ask(depth: Any, others: Any, settings: Any, weight: Any, out: Any) -> None:
    tolerance, needed = settings
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            if not weight[v, u] > 0:
                continue
            total, agreeing, seeing_through = np.float64(depth[v, u]), 0, 0
            for k in range(len(others.depth)):
                step, along = _difference(depth[v, u], u, v, others, k)
                if abs(step) <= tolerance * along:
                    total += depth[v, u] + step
                    agreeing += 1
                elif step > tolerance * along:
                    seeing_through += 1
            if agreeing < needed or seeing_through > agreeing:
                weight[v, u] = 0.0
            else:
                out[v, u] = total / (agreeing + 1)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _difference(depth: Any, u: int, v: int, others: Any, k: int) -> Any:
    """Return how much deeper the other frame sees a pixel, and how deep it is; NaN: unseen."""
    m, height, width = others.from_ray[k], others.depth.shape[1], others.depth.shape[2]
    slope = m[2, 0] * u + m[2, 1] * v + m[2, 2]
    z = depth * slope + others.shift[k, 2]
    if not z > 0:
        return np.nan, np.nan
    x = (depth * (m[0, 0] * u + m[0, 1] * v + m[0, 2]) + others.shift[k, 0]) / z
    y = (depth * (m[1, 0] * u + m[1, 1] * v + m[1, 2]) + others.shift[k, 1]) / z
    if not (x > -0.5 and y > -0.5 and x < width - 0.5 and y < height - 0.5):
        return np.nan, np.nan
    seen = others.depth[k, int(np.floor(y + 0.5)), int(np.floor(x + 0.5))]
    return (seen - z) / slope, np.float64(depth)
