"""The corridor, photographed by a lens that bends: image files whose every pixel is known."""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from corridor import DISTANCES, NORMALS, true_pose
from numpy.typing import NDArray

from laser_slam.camera import distort, intrinsics_matrix, rays, resize_intrinsics
from laser_slam.sim3 import Sim3
from laser_slam.types import (
    Calibration,
    Frame,
    Image,
    Prediction,
    SequenceInfo,
    Trajectory,
    Window,
)

Array = NDArray[np.float64]

SIZE = (108, 192)  # of the photographs
SEEN = (72, 128)  # of what the backbone sees
LENS = intrinsics_matrix(118.0, 117.0, 97.3, 52.1)
DISTORTION = (-0.14, 0.03, 0.002, -0.001)
NO_BEND = (0.0, 0.0, 0.0, 0.0)

LensBend = tuple[float, float, float, float]
UNIT_M = 2.5  # of the first window, and so of the world


def lens_rays(distortion: LensBend) -> Array:
    """Return the (H, W, 3) rays of the photographs' pixels, with z = 1: the lens undone."""
    bent = rays(LENS, *SIZE)[..., :2]
    slopes = bent.copy()
    for _ in range(50):
        slopes += bent - distort(slopes, np.array(distortion))
    return np.concatenate([slopes, np.ones((*SIZE, 1))], axis=-1)


def hit(directions: Array, world_from_cam: Array) -> tuple[Array, NDArray[np.float32]]:
    """Return where (H, W, 3) rays with z = 1 meet the corridor, in metres, and the depth there."""
    turned = directions @ world_from_cam[:3, :3].T
    gap = DISTANCES - NORMALS @ world_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        depths = gap / (turned @ NORMALS.T)
    depth = np.where(depths > 0, depths, np.inf).min(axis=-1)
    return world_from_cam[:3, 3] + turned * depth[..., None], depth.astype(np.float32)


def paint(points: Array) -> Image:
    """Return the colours of points on the corridor: smooth, so that neighbours look alike."""
    waves = [np.sin(points @ np.array(w)) for w in [(0.9, 1.1, 0.4), (1.7, -1.2, 0.7)]]
    channels = [128 + 60 * waves[0], 128 + 60 * waves[1], 128 - 40 * waves[0] + 40 * waves[1]]
    return np.asarray(np.rint(np.stack(channels, axis=-1)).clip(0, 255), np.uint8)


@dataclass
class PhotographedCorridor:
    """The data set; its photographs lie in a folder.

    Attributes:
        folder: of the image files; None: there are none.
        num_frames: of the sequence.
        distortion: of the lens.
    """

    folder: Path | None
    num_frames: int = 24
    distortion: LensBend = DISTORTION

    def write_files(self) -> None:
        assert self.folder is not None
        self.folder.mkdir(parents=True)
        for path, frame in zip(self.info.files, self.frames(), strict=True):
            assert frame.image is not None
            cv2.imwrite(str(path), frame.image[..., ::-1])

    @property
    def info(self) -> SequenceInfo:
        frames = np.arange(self.num_frames)
        files: tuple[Path, ...] = ()
        if self.folder is not None:
            files = tuple(self.folder / f"shot-{frame}.png" for frame in frames)
        return SequenceInfo("photos", SIZE, self.num_frames, LENS, "the plan", None, files)

    def frames(self) -> Generator[Frame, None, None]:
        directions = lens_rays(self.distortion)
        for index in range(self.num_frames):
            yield Frame(index, index / 10.0, paint(hit(directions, true_pose(index))[0]))

    def true_depth(self, frame: int) -> None:
        return None


@dataclass
class TrueEye:
    """A backbone that knows the corridor, and sees it as a pinhole camera does.

    Attributes:
        distortion: of the lens, which it also knows.
        confidence: of all its depth; 0: it sees nothing.
    """

    distortion: LensBend = DISTORTION
    confidence: float = 0.9
    remembers: bool = False
    sees_far_frames: bool = True

    def identity(self) -> dict[str, Any]:
        return {"eye": 1}

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return SEEN

    def calibrate(self, windows: Iterable[Window], intrinsics: Array | None) -> Calibration:
        return Calibration(
            resize_intrinsics(LENS, SIZE, SEEN), np.array(self.distortion), SEEN, "the plan"
        )

    def predict(
        self, images: Sequence[Image], frames: NDArray[np.int64], intrinsics: Array | None
    ) -> Prediction:
        assert intrinsics is not None
        unit_m = UNIT_M if frames[0] == 0 else 1.0 + 0.1 * int(frames[0])
        world_from_cam = np.stack([true_pose(int(frame)) for frame in frames])
        window_from_world = Sim3(scale=1 / unit_m) @ Sim3.from_matrix(world_from_cam[0]).inverse()
        directions = rays(intrinsics, *SEEN)
        depth = np.stack([hit(directions, pose)[1] for pose in world_from_cam]) / np.float32(unit_m)
        confidence = np.full(depth.shape, self.confidence, np.float32)
        return Prediction(
            frames,
            depth,
            confidence,
            window_from_world.apply_poses(world_from_cam),
            np.tile(intrinsics, (len(frames), 1, 1)),
        )


def world_from_metres() -> Sim3:
    """Return what maps the corridor's metres to the world of a run."""
    return Sim3(scale=1 / UNIT_M) @ Sim3.from_matrix(true_pose(0)).inverse()


def true_trajectory(num_frames: int) -> Trajectory:
    """Return the path in the world of a run."""
    poses = np.stack([true_pose(frame) for frame in range(num_frames)])
    frames = np.arange(num_frames)
    return Trajectory(frames, frames / 10.0, world_from_metres().apply_poses(poses))
