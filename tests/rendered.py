"""A few rendered frames of the generated street, with their truth."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import project
from laser_slam.config import SyntheticConfig
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.sim3 import Array
from laser_slam.types import Image


@dataclass(frozen=True)
class RenderedDrive:
    """Images, (N, H, W) depths in metres, (3, 3) intrinsics and (N, 4, 4) world_from_cam."""

    images: list[Image]
    depths: NDArray[np.float32]
    intrinsics: Array
    world_from_cam: Array

    @property
    def greys(self) -> list[NDArray[np.uint8]]:
        return [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in self.images]

    @property
    def centres(self) -> Array:
        return self.world_from_cam[:, :3, 3]

    @property
    def path_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.centres, axis=0), axis=1).sum())


def render_drive(num_frames: int) -> RenderedDrive:
    drive = SyntheticDrive(SyntheticConfig(num_frames=num_frames, width=640, height=192))
    truth, K = drive.info.truth, drive.info.intrinsics
    assert truth is not None
    assert K is not None
    images = [frame.image for frame in drive.frames() if frame.image is not None]
    depths = np.stack([drive.true_depth(frame) for frame in range(num_frames)])
    return RenderedDrive(images, depths, K, truth.world_from_cam)


def seen_from(drive: RenderedDrive, first: int, second: int, pixels: Array) -> Array:
    """Return where (N, 2) pixels of one frame truly are in another; NaN: hidden, or at an edge."""
    x, y = np.rint(pixels).astype(int).T
    depth = drive.depths[first]
    around = np.stack([depth[y + j, x + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    z = depth[y, x].astype(np.float64)
    rays = np.linalg.solve(drive.intrinsics, np.vstack([pixels.T, np.ones(len(x))])).T
    second_from_first = np.linalg.inv(drive.world_from_cam[second]) @ drive.world_from_cam[first]
    points = (rays * z[:, None]) @ second_from_first[:3, :3].T + second_from_first[:3, 3]
    out = project(points, drive.intrinsics)
    height, width = depth.shape
    inside = np.all((out >= 10) & (out <= [width - 11, height - 11]), axis=1)
    u, v = np.rint(np.where(inside[:, None], out, 0)).astype(int).T
    is_smooth = np.ptp(around, axis=0) < 0.05 * z
    is_visible = np.abs(drive.depths[second][v, u] / points[:, 2] - 1) < 0.03
    out[~(inside & is_smooth & is_visible)] = np.nan
    return out
