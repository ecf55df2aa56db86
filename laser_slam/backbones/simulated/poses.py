"""True poses as a network would give them: noise on each, and a drift over the window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import SimulatedConfig
from laser_slam.sim3 import rotation_exp

Array = NDArray[np.float64]

PER_AXIS = 1 / np.sqrt(3)  # of the length of a vector with three alike


def distort_poses(
    window_from_cam: Array, config: SimulatedConfig, generator: np.random.Generator
) -> Array:
    """Bend the path of a window and shake each of its poses.

    Args:
        window_from_cam: (N, 4, 4) true, rigid, in median depths.
        config: the strengths.
        generator: of the window.

    Returns:
        (N, 4, 4) rigid, in median depths; the first is the true one but for its noise.
    """
    turn, slip = PER_AXIS * generator.standard_normal((2, 3))
    turn *= np.radians(config.drift_rotation_deg)
    slip *= config.drift_translation
    out = np.array(window_from_cam, dtype=np.float64)
    for i in range(1, len(out)):
        step = np.linalg.inv(window_from_cam[i - 1]) @ window_from_cam[i]
        step[:3, 3] += slip * np.linalg.norm(step[:3, 3])
        step[:3, :3] = rotation_exp(turn) @ step[:3, :3]
        out[i] = out[i - 1] @ step
    shake = PER_AXIS * generator.standard_normal((2, len(out), 3))
    out[:, :3, :3] @= rotation_exp(np.radians(config.pose_rotation_deg) * shake[0])
    out[:, :3, 3] += config.pose_translation * shake[1]
    return out
