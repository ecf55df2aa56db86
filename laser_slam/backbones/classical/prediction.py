"""What a window's reconstruction says, in the words of all backbones."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.dense import PosedFrames, dense_depth, depth_size
from laser_slam.backbones.classical.reconstruction import Reconstruction, collect
from laser_slam.backbones.classical.tracking import FrameTracks
from laser_slam.backbones.classical.twoview import MIN_MATCHES, measure_motion
from laser_slam.camera import resize_intrinsics
from laser_slam.config import ClassicalConfig
from laser_slam.sim3 import Array, complete_poses
from laser_slam.types import Prediction, WindowStatus

STILL_PX = 1.5  # flow at 640 wide over a window; below, the camera stands
TURNING_PX = 1.5  # parallax at 640 wide over a window; below, the camera only turns ...
TURNING_SHARE = 0.03  # ... or parallax per flow: intrinsics are never exact
MIN_ANCHORED = 60  # matches; with fewer, flow is measured from a later frame
MOVED_PX = 4.0  # of a track, at 640 wide; what moves less fits anything
FEW_FIT = 0.65  # share of the tracks that fit a static scene; less is worth a warning


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
    return Prediction(
        frames,
        _spread(depth / unit, slots, len(frames), np.nan),
        _spread(confidence, slots, len(frames), 0.0),
        np.linalg.inv(poses[0]) @ poses,
        np.tile(depth_K, (len(frames), 1, 1)),
        warnings=_warnings(views, solution, len(frames)),
    )


def _warnings(views: list[FrameTracks], solution: Reconstruction, num: int) -> tuple[str, ...]:
    """Say what a person should know of a window, the last ``num`` of the views."""
    missing = num - int(solution.has_pose[-num:].sum())
    out = [f"{missing} of {num} frames could not be placed"] if missing else []
    tracks = collect([views[c] for c in np.flatnonzero(solution.has_pose)])
    starts = tracks.starts[:-1]
    highest = np.maximum.reduceat(tracks.pixels, starts)
    spread = highest - np.minimum.reduceat(tracks.pixels, starts)
    unit = views[0].grey.shape[1] / 640
    did_move = tracks.ids[spread.max(axis=1) > MOVED_PX * unit]
    share = float(np.isin(did_move, solution.ids).mean()) if len(did_move) else 1.0
    if share < FEW_FIT:
        out.append(
            f"only {share:.0%} of the tracks fit a static scene: things move, or the camera differs"
        )
    return tuple(out)


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


@dataclass(frozen=True)
class Turn:
    """How a camera turned over a window, if turning is all it did.

    Attributes:
        window_from_cam: (N, 3, 3) rotations.
        flow_px: the longest median flow between any frame and the one it was measured from.
        parallax_px: the largest flow that neither the rotation nor a camera that is slightly
            other than thought explains.
    """

    window_from_cam: Array
    flow_px: float
    parallax_px: float


def follow_turn(views: list[FrameTracks], K: Array) -> Turn | None:
    """Measure rotation, flow and parallax over as many frames as the tracks last.

    A slow motion hides between neighbours, not over a window.

    Returns:
        None: some frames have too few tracks in common, or there is one frame only.
    """
    rotations, flow, parallax = [np.eye(3)], 0.0, 0.0
    anchor = 0
    for i in range(1, len(views)):
        motion = measure_motion(views[anchor], views[i], K)
        if motion.num_matches < MIN_ANCHORED and anchor < i - 1:
            anchor = i - 1
            motion = measure_motion(views[anchor], views[i], K)
        if motion.num_matches < MIN_MATCHES:
            return None
        rotations.append(rotations[anchor] @ motion.second_from_first.T)
        flow = max(flow, motion.flow_px)
        parallax = max(parallax, motion.parallax_px - TURNING_SHARE * motion.flow_px)
    return Turn(np.stack(rotations), flow, parallax) if len(views) > 1 else None


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
    turn = follow_turn(views, K)
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    status = WindowStatus.FAILED
    if turn is not None and turn.flow_px < STILL_PX * unit:
        status = WindowStatus.STATIC
    elif turn is not None and turn.parallax_px < TURNING_PX * unit:
        status = WindowStatus.ROTATION
        poses[:, :3, :3] = turn.window_from_cam
    size = depth_size((height, width), config.depth_width)
    depth = np.full((len(frames), *size), np.nan, np.float32)
    depth_K = np.tile(resize_intrinsics(K, (height, width), size), (len(frames), 1, 1))
    return Prediction(frames, depth, np.zeros_like(depth), poses, depth_K, status)
