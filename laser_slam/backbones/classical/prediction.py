"""What a window's reconstruction says, in the words of all backbones."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.dense import PosedFrames, dense_depth, depth_size
from laser_slam.backbones.classical.reconstruction import Reconstruction
from laser_slam.backbones.classical.tracking import FrameTracks
from laser_slam.backbones.classical.twoview import MIN_MATCHES, measure_motion
from laser_slam.camera import resize_intrinsics
from laser_slam.config import ClassicalConfig
from laser_slam.sim3 import Array, complete_poses
from laser_slam.types import Prediction, WindowStatus

STILL_PX = 1.5  # flow at 640 wide between two frames; below, the camera stands
TURNING_PX = 1.5  # parallax at 640 wide between two frames; below, the camera only turns


def with_depth(
    views: list[FrameTracks],
    solution: Reconstruction,
    frames: NDArray[np.int64],
    K: Array,
    config: ClassicalConfig,
    workers: ThreadPoolExecutor,
) -> Prediction:
    """Sweep the window's frames, and express everything in units of the median sparse depth.

    Args:
        views: the frames that were reconstructed: context, then window.
        solution: their poses and points.
        frames: (N,) indices of the window.
        K: (3, 3) intrinsics in pixels of the images.
        config: of the sweep.
        workers: threads.
    """
    posed = np.flatnonzero(solution.has_pose)
    scene = PosedFrames(
        [views[c].grey for c in posed],
        solution.rotations[posed],
        solution.translations[posed],
        [solution.depths_of(int(c)) for c in posed],
        K,
    )
    wanted = [i for i, c in enumerate(posed) if views[c].frame >= frames[0]]
    depth, confidence, depth_K = dense_depth(scene, wanted, config, workers)
    unit = float(np.median(np.concatenate([scene.sparse_depths[i] for i in wanted])))
    known = np.array([views[posed[i]].frame for i in wanted])
    slots = np.searchsorted(frames, known)
    poses = complete_poses(frames, known, _cam_to_window(scene, wanted, unit))
    missing = len(frames) - len(known)
    return Prediction(
        frames,
        _spread(depth / unit, slots, len(frames), np.nan),
        _spread(confidence, slots, len(frames), 0.0),
        np.linalg.inv(poses[0]) @ poses,
        np.tile(depth_K, (len(frames), 1, 1)),
        warnings=(f"{missing} of {len(frames)} frames could not be placed",) if missing else (),
    )


def _cam_to_window(scene: PosedFrames, wanted: list[int], unit: float) -> Array:
    """Return (N, 4, 4) window_from_cam of some frames, lengths in ``unit``."""
    rotations, translations = scene.rotations[wanted], scene.translations[wanted]
    out = np.tile(np.eye(4), (len(wanted), 1, 1))
    out[:, :3, :3] = rotations.transpose(0, 2, 1)
    out[:, :3, 3] = -np.einsum("cij,ci->cj", rotations, translations) / unit
    return out


def _spread(
    maps: NDArray[np.float32], slots: NDArray[np.int64], num: int, empty: float
) -> NDArray[np.float32]:
    """Put maps in their slots among ``num``, the others empty."""
    out = np.full((num, *maps.shape[1:]), empty, np.float32)
    out[slots] = maps
    return out


def without_depth(
    views: list[FrameTracks], frames: NDArray[np.int64], K: Array, config: ClassicalConfig
) -> Prediction:
    """Say what can be said of a window that could not be reconstructed: how it turned, perhaps.

    Args:
        views: the frames of the window.
        frames: (N,) their indices.
        K: (3, 3) intrinsics in pixels of the images.
        config: size of the depth maps.
    """
    height, width = views[0].grey.shape
    unit = width / 640
    motions = [measure_motion(first, second, K) for first, second in pairwise(views)]
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    status = WindowStatus.FAILED
    is_seen = all(motion.num_matches >= MIN_MATCHES for motion in motions)
    if is_seen and max(motion.flow_px for motion in motions) < STILL_PX * unit:
        status = WindowStatus.STATIC
    elif is_seen and max(motion.parallax_px for motion in motions) < TURNING_PX * unit:
        status = WindowStatus.ROTATION
        for i, motion in enumerate(motions):
            poses[i + 1, :3, :3] = poses[i, :3, :3] @ motion.second_from_first.T
    size = depth_size((height, width), config.depth_width)
    depth = np.full((len(frames), *size), np.nan, np.float32)
    depth_K = np.tile(resize_intrinsics(K, (height, width), size), (len(frames), 1, 1))
    return Prediction(frames, depth, np.zeros_like(depth), poses, depth_K, status)
