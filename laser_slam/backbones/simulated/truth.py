"""The truth of a data set, at the size of the depth maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import resize_intrinsics
from laser_slam.errors import ConfigError
from laser_slam.sim3 import complete_poses
from laser_slam.types import SequenceInfo

Array = NDArray[np.float64]
Map = NDArray[np.float32]
TrueDepth = Callable[[int], Map | None]

SAMPLES = 8  # frames that are looked at before the run
STRIDE = 4  # of the pixels that a median is taken of


@dataclass(frozen=True)
class WindowTruth:
    """What is true of one window.

    Attributes:
        depths: N maps (H, W), z in metres; NaN: unknown.
        world_from_cam: (N, 4, 4), metres.
        median_m: median of the known depths; NaN: none is known.
        warnings: what is not from the data set itself.
    """

    depths: list[Map]
    world_from_cam: Array
    median_m: float
    warnings: tuple[str, ...]


class Truth:
    """Ground-truth depth and poses, read window by window.

    Attributes:
        intrinsics: (3, 3) in pixels of the depth maps.
        size: (height, width) of the depth maps.
        trajectory: of the frames that have a true pose, in metres.
        samples: what is true of some frames all over the sequence that have depth.

    Raises:
        ConfigError: the data set lacks true poses or depth, or the intrinsics.
    """

    def __init__(
        self, info: SequenceInfo | None, true_depth: TrueDepth | None, size: tuple[int, int]
    ) -> None:
        if info is None or info.truth is None or not len(info.truth.frames):
            raise _refusal("ground-truth poses", info)
        if info.intrinsics is None:
            raise _refusal("known intrinsics", info)
        if true_depth is None:
            raise _refusal("ground-truth depth", info)
        self._true_depth, self.trajectory = true_depth, info.truth
        self._recent: dict[int, Map | None] = {}  # of the last window: the next shares some
        self.size = size
        self.intrinsics = resize_intrinsics(info.intrinsics, info.size, size)
        self.samples = self._sample()
        if not np.isfinite(self.samples.median_m):
            raise _refusal("ground-truth depth", info)

    def window(self, frames: NDArray[np.int64]) -> WindowTruth:
        """Read the truth of some frames.

        Depth comes by the nearest pixel: an average over a depth edge is nowhere. A frame without
        a true pose gets one between its neighbours', beyond the ends at their speed.

        Raises:
            DatasetError: the true depth of a frame cannot be read.
        """
        known = self._recent
        self._recent = {
            frame: known[frame] if frame in known else self._read(frame)
            for frame in (int(index) for index in frames)
        }
        unknown = np.full(self.size, np.nan, np.float32)
        depths = [unknown if depth is None else depth for depth in self._recent.values()]
        poses = complete_poses(frames, self.trajectory.frames, self.trajectory.world_from_cam)
        return WindowTruth(depths, poses, _median(depths), self._missing(frames))

    def _read(self, frame: int) -> Map | None:
        depth = self._true_depth(frame)
        if depth is None:
            return None
        # INTER_NEAREST would take each block's corner, half a block off
        method = cv2.INTER_NEAREST_EXACT
        return np.asarray(cv2.resize(depth, self.size[::-1], interpolation=method), np.float32)

    def _missing(self, frames: NDArray[np.int64]) -> tuple[str, ...]:
        without_pose = int((~np.isin(frames, self.trajectory.frames)).sum())
        without_depth = sum(depth is None for depth in self._recent.values())
        warnings = []
        if without_pose:
            warnings.append(f"{without_pose} frames have no true pose: taken from their neighbours")
        if without_depth:
            warnings.append(f"{without_depth} frames have no true depth: left unknown")
        return tuple(warnings)

    def _sample(self) -> WindowTruth:
        """Read some frames all over the sequence, those that have a true pose."""
        known = self.trajectory.frames
        chosen = np.unique(np.linspace(0, len(known) - 1, SAMPLES).astype(np.int64))
        read = {int(i): self._read(int(known[i])) for i in chosen}
        depths = {i: depth for i, depth in read.items() if depth is not None}
        poses = self.trajectory.world_from_cam[list(depths)]
        return WindowTruth(list(depths.values()), poses, _median(list(depths.values())), ())


def _median(depths: list[Map]) -> float:
    """Return the median of the known depths; NaN: none is known."""
    if not depths:
        return float("nan")
    values = np.concatenate([depth[::STRIDE, ::STRIDE].ravel() for depth in depths])
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _refusal(what: str, info: SequenceInfo | None) -> ConfigError:
    name = "this input" if info is None else info.name
    return ConfigError(
        f"backbone.name: simulated needs {what}, which {name} lacks; use another backbone, "
        "such as classical"
    )
