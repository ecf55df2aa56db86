"""What the stages hand to each other. Axes: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.sim3 import Sim3

Image = NDArray[np.uint8]

NO_DISTORTION: NDArray[np.float64] = np.zeros(4)
NO_DISTORTION.setflags(write=False)


@dataclass(frozen=True)
class Frame:
    """One image of the sequence.

    Attributes:
        index: position in the sequence, from 0.
        time_s: seconds; strictly rising over the sequence.
        image: (H, W, 3) RGB; None: this frame could not be read.
    """

    index: int
    time_s: float
    image: Image | None


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time.

    Attributes:
        frames: (N,) rising frame indices.
        times_s: (N,) seconds.
        world_from_cam: (N, 4, 4) rigid, in world units.
    """

    frames: NDArray[np.int64]
    times_s: NDArray[np.float64]
    world_from_cam: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Refuse shapes that disagree, frames that do not rise and poses that are not finite."""
        num = len(self.frames)
        if self.times_s.shape != (num,) or self.world_from_cam.shape != (num, 4, 4):
            raise ValueError(f"a trajectory of {num} frames needs as many times and 4x4 poses")
        if not (np.diff(self.frames) > 0).all():
            raise ValueError("frame indices must be rising")
        if not np.isfinite(self.world_from_cam).all():
            raise ValueError("a trajectory must be finite")


@dataclass(frozen=True)
class SequenceInfo:
    """What a data set knows of a sequence before its images are read.

    Attributes:
        name: short name, for the run folder and the report.
        size: (height, width) of all images, in pixels.
        num_frames: None when only reading to the end tells.
        intrinsics: (3, 3) in pixels of the images; None: unknown.
        intrinsics_source: where they come from, or why they are unknown, in words.
        truth: poses in metres, for all frames or some; None: no ground truth.
        files: the image of each frame; a single one: the video that all are of; empty: there are
            none that another program could open.
    """

    name: str
    size: tuple[int, int]
    num_frames: int | None
    intrinsics: NDArray[np.float64] | None
    intrinsics_source: str
    truth: Trajectory | None = None
    files: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """How the camera projects.

    Attributes:
        intrinsics: (3, 3) in pixels; None: unknown, the backbone finds its own for each window.
        distortion: (4,) radial k1, k2 and tangential p1, p2 as OpenCV defines them.
        size: (height, width) of the images that it is for.
        source: where it comes from, in words.
        warning: what a person should know of it, one sentence; None: nothing.
    """

    intrinsics: NDArray[np.float64] | None
    distortion: NDArray[np.float64]
    size: tuple[int, int]
    source: str
    warning: str | None = None


@dataclass(frozen=True)
class Window:
    """Consecutive keyframes that are given to the backbone at once.

    Attributes:
        index: position in the run, from 0.
        frames: (N,) rising frame indices.
        images: N images (H, W, 3) RGB, at the size that the backbone wants.
    """

    index: int
    frames: NDArray[np.int64]
    images: tuple[Image, ...]


class WindowStatus(StrEnum):
    """How much of a window a backbone could see."""

    OK = "ok"
    STATIC = "static"  # no motion: identity poses, no depth
    ROTATION = "rotation"  # rotation without translation: rotations hold, no depth
    FAILED = "failed"  # nothing holds: too few features, blank or corrupt frames


@dataclass(frozen=True)
class Prediction:
    """A backbone's view of one window, in the window's own unit of length.

    Attributes:
        frames: (N,) rising indices in the sequence.
        depth: (N, H, W) z along the optical axis; NaN: unknown.
        confidence: (N, H, W) in [0, 1]; comparable within the window; 0 where depth is unknown.
        window_from_cam: (N, 4, 4) rigid.
        intrinsics: (N, 3, 3) in pixels of the depth map.
        status: what holds; anything but OK has no depth at all.
        warnings: what a person should know of this window, one sentence each.
        tokens: (N, D) what the backbone's own encoder makes of each image, pooled over it: it can
            tell places apart; None: it has no encoder.

    Raises:
        ValueError: shapes disagree, frames do not rise, poses are not finite, confidence leaves
            [0, 1], or depth has confidence but is not positive and finite.
    """

    frames: NDArray[np.int64]
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    window_from_cam: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    status: WindowStatus = WindowStatus.OK
    warnings: tuple[str, ...] = ()
    tokens: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Check shapes and finiteness once, here."""
        num = len(self.frames)
        if self.depth.ndim != 3 or len(self.depth) != num:
            raise ValueError(f"depth must be ({num}, H, W), got {self.depth.shape}")
        if self.confidence.shape != self.depth.shape:
            raise ValueError(f"confidence {self.confidence.shape}, depth {self.depth.shape}")
        if self.window_from_cam.shape != (num, 4, 4) or self.intrinsics.shape != (num, 3, 3):
            raise ValueError("poses must be (N, 4, 4) and intrinsics (N, 3, 3)")
        if not (np.isfinite(self.window_from_cam).all() and np.isfinite(self.intrinsics).all()):
            raise ValueError("poses and intrinsics must be finite")
        if not (np.diff(self.frames) > 0).all():
            raise ValueError("frame indices must be rising")
        _check_tokens(self.tokens, num)
        if not ((self.confidence >= 0) & (self.confidence <= 1)).all():
            raise ValueError("confidence must be in [0, 1]")
        seen = self.depth[self.confidence > 0]
        if not ((seen > 0) & (seen < np.inf)).all():
            raise ValueError("depth must be positive and finite where confidence is above 0")


def _check_tokens(tokens: NDArray[np.float32] | None, num: int) -> None:
    if tokens is None:
        return
    if tokens.ndim != 2 or len(tokens) != num or not np.isfinite(tokens).all():
        raise ValueError(f"tokens must be ({num}, D) and finite, got {tokens.shape}")


@dataclass(frozen=True)
class Registration:
    """The Sim(3) between two windows that share frames, with its uncertainty.

    Attributes:
        previous_from_current: maps points of the current window to the previous one.
        sigmas: (7,) standard deviations: rotation x, y, z (radians, previous window's axes),
            translation x, y, z (previous window's units), log-scale.
        num_pixels: pixels that voted for the scale; 0: the scale was assumed.
        residual: median absolute log-ratio of the depths after alignment; NaN without pixels.
        bridged: why this is a guess and no measurement; None: it was measured.
    """

    previous_from_current: Sim3
    sigmas: NDArray[np.float64]
    num_pixels: int
    residual: float
    bridged: str | None = None


@dataclass(frozen=True)
class Layers:
    """The depth layers of one window, and what layer-wise scale alignment makes of them.

    Kept beside the depth as it was predicted, and applied on use: a node that moves in the pose
    graph takes its layers along, for their scales are relative to its own.

    Attributes:
        labels: (N, h, w) layer of each pixel, from 1 in each frame; 0: depth unknown. A cell
            stands for a block of f x f pixels, where h = ceil(H / f) and w = ceil(W / f).
        starts: (N + 1,) where the layers of each frame begin in ``scales``: layer ``k`` of frame
            ``i`` is row ``starts[i] + k - 1``.
        scales: (M,) factor on the depth of each layer; 1: as predicted.
        witnesses: (M,) how many windows agreed on the scale, this one included; a layer that no
            earlier window has seen has 1.
        curve: (K, 2) depths in window units, rising, and the factor there, on top of ``scales``;
            between them the logarithms are interpolated, outside the ends hold. Empty: none.

    Raises:
        ValueError: shapes disagree, or a scale is not positive and finite.
    """

    labels: NDArray[np.uint16]
    starts: NDArray[np.int64]
    scales: NDArray[np.float64]
    witnesses: NDArray[np.float64]
    curve: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check shapes and values once, here."""
        num = len(self.scales)
        if self.labels.ndim != 3 or len(self.starts) != len(self.labels) + 1:
            raise ValueError(f"labels {self.labels.shape}, starts {self.starts.shape}")
        if self.starts[0] != 0 or self.starts[-1] != num or self.witnesses.shape != (num,):
            raise ValueError(f"{num} scales, starts {self.starts[[0, -1]]}")
        if self.curve.ndim != 2 or self.curve.shape[1] != 2:
            raise ValueError(f"a curve must be (K, 2), got {self.curve.shape}")
        for factors in (self.scales, self.curve):
            if not ((factors > 0) & (factors < np.inf)).all():
                raise ValueError("layer scales must be positive and finite")


@dataclass(frozen=True)
class Submap:
    """A prediction with its place in the world.

    Attributes:
        index: of its window.
        prediction: the backbone's view; where layers were aligned, with their scales applied.
        colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.
        world_from_window: its Sim(3) node.
        is_owned: (N,) True where this window gives the frame to trajectory and map.
        registration: to the window before; None for the first.
        places: ``world_from_window`` of each frame, which differ where closures have bent the
            chain of windows; empty: ``world_from_window`` for all.
    """

    index: int
    prediction: Prediction
    colors: Image
    world_from_window: Sim3
    is_owned: NDArray[np.bool_]
    registration: Registration | None
    places: tuple[Sim3, ...] = ()


@dataclass(frozen=True)
class Cloud:
    """Coloured points: the dense map.

    Attributes:
        points: (N, 3) in world units.
        colors: (N, 3) RGB uint8.
        weights: (N,) summed confidence of the pixels behind each point.
        voxel_size: edge of the voxels, about the points' distance, in world units; 0: unknown.
        normals: (N, 3) unit normals towards the cameras; None: unknown.

    Raises:
        ValueError: shapes disagree or a point is not finite.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    weights: NDArray[np.float32]
    voxel_size: float = 0.0
    normals: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Check shapes and finiteness once, here."""
        num, shapes = len(self.points), {self.points.shape, self.colors.shape}
        if shapes != {(num, 3)}:
            raise ValueError(f"points {self.points.shape}, colors {self.colors.shape}")
        normals = self.points if self.normals is None else self.normals
        if self.weights.shape != (num,) or normals.shape != (num, 3):
            raise ValueError(f"a cloud of {num} points needs as many weights and normals")
        if not np.isfinite(self.points).all():
            raise ValueError("the points of a cloud must be finite")
