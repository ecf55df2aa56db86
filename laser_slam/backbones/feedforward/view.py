"""From what networks say to predictions: true rotations, and honest gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.sim3 import complete_poses, orthonormal
from laser_slam.types import Prediction, WindowStatus

Array = NDArray[np.float64]
Map = NDArray[np.float32]

SIGHTLESS = "the network gives no finite depth and pose, so that nothing of this window is known"
LENSLESS = "the network's rays are those of no pinhole camera, so that nothing of it is used"


@dataclass(frozen=True)
class View:
    """What a network says of a window, as it says it: any number may be wild.

    Attributes:
        depth: (N, H, W) z.
        confidence: (N, H, W) in [0, 1].
        window_from_cam: (N, 4, 4) rigid but for rounding, in a frame of the network's choice.
        intrinsics: (3, 3) in pixels of the depth maps; None: it sees with no pinhole camera.
        tokens: (N, D) of its encoder; None: it gives none.
    """

    depth: Map
    confidence: Map
    window_from_cam: Array
    intrinsics: Array | None
    tokens: Map | None = None


def to_prediction(view: View, frames: NDArray[np.int64]) -> Prediction:
    """Make a prediction of what a network says; the first camera is the window's frame.

    Depth that is not finite, not positive or not trusted at all becomes unknown. A frame without
    finite pose takes one from its neighbours, and its depth becomes unknown.

    Args:
        view: of the window.
        frames: (N,) rising indices in the sequence.
    """
    depth, confidence = view.depth.astype(np.float32), view.confidence.astype(np.float32)
    is_posed = np.asarray(np.isfinite(view.window_from_cam).all(axis=(1, 2)))
    with np.errstate(invalid="ignore"):
        valid = (depth > 0) & (depth < np.inf) & (confidence > 0) & is_posed[:, None, None]
    if view.intrinsics is None or not valid.any():
        return _nothing(view, frames, LENSLESS if valid.any() else SIGHTLESS)
    poses = _from_first(_complete(view.window_from_cam, frames, is_posed))
    warnings = () if is_posed.all() else (_unposed(frames[~is_posed]),)
    return Prediction(
        frames,
        np.where(valid, depth, np.float32(np.nan)),
        np.where(valid, np.minimum(confidence, 1), np.float32(0)),
        poses,
        np.tile(view.intrinsics, (len(frames), 1, 1)),
        WindowStatus.OK,
        warnings,
        _finite(view.tokens),
    )


def blind_view(shape: tuple[int, int, int]) -> View:
    """Return the view of (N, H, W) pixels that a network has no finite number for."""
    nothing = np.full(shape, np.nan, np.float32)
    return View(nothing, nothing, np.full((shape[0], 4, 4), np.nan), None)


def inverted(rigid: Array) -> Array:
    """Return the inverses of (N, 4, 4) rigid transforms; not finite where they are not."""
    out = np.array(rigid)
    out[:, :3, :3] = rigid[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], rigid[:, :3, 3])
    return out


def _complete(poses: Array, frames: NDArray[np.int64], is_posed: NDArray[np.bool_]) -> Array:
    out = poses[is_posed].astype(np.float64)
    for pose in out:
        pose[:3, :3] = orthonormal(pose[:3, :3])
        pose[3] = [0, 0, 0, 1]
    return out if is_posed.all() else complete_poses(frames, frames[is_posed], out)


def _from_first(poses: Array) -> Array:
    """Return (N, 4, 4) rigid poses in the frame of the first."""
    rotation, centre = poses[0, :3, :3], poses[0, :3, 3]
    out = np.array(poses)
    out[:, :3, :3] = rotation.T @ poses[:, :3, :3]
    out[:, :3, 3] = (poses[:, :3, 3] - centre) @ rotation
    out[0] = np.eye(4)  # to the last bit
    return out


def _nothing(view: View, frames: NDArray[np.int64], why: str) -> Prediction:
    num, height, width = view.depth.shape
    K = intrinsics_matrix(width, width, (width - 1) / 2, (height - 1) / 2)
    return Prediction(
        frames,
        np.full(view.depth.shape, np.nan, np.float32),
        np.zeros(view.depth.shape, np.float32),
        np.tile(np.eye(4), (num, 1, 1)),
        np.tile(K if view.intrinsics is None else view.intrinsics, (num, 1, 1)),
        WindowStatus.FAILED,
        (why,),
        _finite(view.tokens),
    )


def _unposed(frames: NDArray[np.int64]) -> str:
    named = ", ".join(str(frame) for frame in frames[:5]) + (", ..." if len(frames) > 5 else "")
    return f"the network gives no finite pose of {len(frames)} frames ({named}): interpolated"


def _finite(tokens: Map | None) -> Map | None:
    """Return tokens as they are kept; zeros, which are like nothing, where they are wild."""
    if tokens is None:
        return None
    is_finite = np.isfinite(tokens).all(axis=1, keepdims=True)
    return np.where(is_finite, tokens, 0).astype(np.float32)
