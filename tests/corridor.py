"""A corridor with analytic depth: a data set and a backbone whose every answer is known."""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_from_fov, rays
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import (
    NO_DISTORTION,
    Calibration,
    Frame,
    Image,
    Prediction,
    SequenceInfo,
    Trajectory,
    Window,
    WindowStatus,
)

SIZE = (72, 128)
STEP_M = 0.4
# Planes n . p = d of the corridor, in metres: floor, ceiling, walls, far end.
NORMALS = np.array([[0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1.0]])
DISTANCES = np.array([1.6, 3.0, 4.0, 4.0, 60.0])


def true_pose(frame: int) -> NDArray[np.float64]:
    """Return world_from_cam: forward, gently weaving."""
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = rotation_exp(np.array([0.0, 0.1 * np.sin(frame / 15), 0.0]))
    world_from_cam[:3, 3] = [0.8 * np.sin(frame / 20), 0.05 * np.sin(frame / 7), STEP_M * frame]
    return world_from_cam


def true_intrinsics() -> NDArray[np.float64]:
    return intrinsics_from_fov(80.0, *SIZE)


def view(frame: int) -> tuple[Image, NDArray[np.float32]]:
    """Render colours and depth (z, metres)."""
    world_from_cam = true_pose(frame)
    directions = rays(true_intrinsics(), *SIZE) @ world_from_cam[:3, :3].T
    gap = DISTANCES - NORMALS @ world_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        depths = gap / (directions @ NORMALS.T)
    depth = np.where(depths > 0, depths, np.inf).min(axis=-1)
    points = world_from_cam[:3, 3] + directions * depth[..., None]
    waves = [
        np.sin(points @ np.array(w)) for w in [(3, 2, 1), (7, 5, -6), (-2, 9, 4), (1.1, 0.7, 0.9)]
    ]
    grey = 128 + 30 * sum(waves)
    colors = np.stack([grey, grey * 0.9, 255 - grey], axis=-1)
    return np.clip(colors, 0, 255).astype(np.uint8), depth.astype(np.float32)


@dataclass
class Corridor:
    """The data set."""

    num_frames: int = 60
    unreadable: tuple[int, ...] = ()
    with_truth: bool = True
    with_intrinsics: bool = True
    name: str = "corridor"

    @property
    def info(self) -> SequenceInfo:
        frames = np.arange(self.num_frames)
        poses = np.stack([true_pose(int(frame)) for frame in frames])
        return SequenceInfo(
            name=self.name,
            size=SIZE,
            num_frames=self.num_frames,
            intrinsics=true_intrinsics() if self.with_intrinsics else None,
            intrinsics_source="the corridor's plan",
            truth=Trajectory(frames, frames / 10.0, poses) if self.with_truth else None,
        )

    def frames(self) -> Generator[Frame, None, None]:
        for index in range(self.num_frames):
            image = None if index in self.unreadable else view(index)[0]
            yield Frame(index, index / 10.0, image)

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        return view(frame)[1] if self.with_truth else None


def true_prediction(
    frames: NDArray[np.int64], unit_m: float = 1.0, status: WindowStatus = WindowStatus.OK
) -> Prediction:
    """Answer with the truth, in the frame of the window's first camera and a unit of its own."""
    num = len(frames)
    intrinsics = np.tile(true_intrinsics(), (num, 1, 1))
    world_from_cam = np.stack([true_pose(int(frame)) for frame in frames])
    window_from_world = Sim3(scale=1 / unit_m) @ Sim3.from_matrix(world_from_cam[0]).inverse()
    window_from_cam = window_from_world.apply_poses(world_from_cam)
    if status is WindowStatus.OK:
        depth = np.stack([view(int(frame))[1] for frame in frames]) / np.float32(unit_m)
        confidence = np.full(depth.shape, 0.9, np.float32)
        confidence[:, : SIZE[0] // 2] = 0.7
    else:
        window_from_cam[:, :3, 3] = 0
        if status is not WindowStatus.ROTATION:
            window_from_cam[:] = np.eye(4)
        depth = np.full((num, *SIZE), np.nan, np.float32)
        confidence = np.zeros(depth.shape, np.float32)
    return Prediction(frames, depth, confidence, window_from_cam, intrinsics, status)


@dataclass
class TrueBackbone:
    """A backbone that knows the corridor; it can be told to fail in some windows."""

    statuses: dict[int, WindowStatus] = field(default_factory=dict)
    interrupt_at: int | None = None
    calls: int = 0
    remembers: bool = False
    sees_far_frames: bool = True

    def identity(self) -> dict[str, Any]:
        return {"corridor": 1}

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return size

    def calibrate(
        self, windows: Iterable[Window], intrinsics: NDArray[np.float64] | None
    ) -> Calibration:
        return Calibration(intrinsics, NO_DISTORTION, SIZE, "given")

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        call, self.calls = self.calls, self.calls + 1
        if call == self.interrupt_at:
            raise KeyboardInterrupt
        seed = call if self.remembers else int(frames[0])
        unit_m = float(np.random.default_rng(seed).uniform(0.5, 8.0))
        return true_prediction(frames, unit_m, self.statuses.get(call, WindowStatus.OK))
