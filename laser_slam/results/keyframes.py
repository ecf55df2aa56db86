"""Where the keyframes of a run ended up."""

from __future__ import annotations

import numpy as np

from laser_slam.slam import Slam
from laser_slam.store.keyframes import Keyframes


def list_keyframes(slam: Slam) -> Keyframes:
    """List the keyframes in order, each at the place that the window that owns it gives it."""
    frames, windows, places, poses = [], [], [], []
    for node, owned in zip(slam.nodes, slam.frame_places(), strict=True):
        for row, place in zip(np.flatnonzero(node.is_owned), owned, strict=True):
            frames.append(int(node.frames[row]))
            windows.append(node.index)
            places.append(place.matrix())
            poses.append(place.apply_poses(node.window_from_cam[row]))
    return Keyframes(
        np.array(frames, np.int64),
        np.array(windows, np.int64),
        np.array(places).reshape(-1, 4, 4),
        np.array(poses).reshape(-1, 4, 4),
    )
