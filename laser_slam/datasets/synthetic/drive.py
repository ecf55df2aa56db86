"""The synthetic drive as a data set: generated images with exact depth and poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.config import SyntheticConfig
from laser_slam.datasets.synthetic.paths import (
    loop_path,
    path_from_kitti_poses,
    read_kitti_poses,
)
from laser_slam.datasets.synthetic.render import Renderer
from laser_slam.datasets.synthetic.world import build_world
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, Image, SequenceInfo, Trajectory

Array = NDArray[np.float64]

FRAME_RATE_HZ = 10.0
WORKERS = 2
AHEAD = 6  # frames that are rendered before they are asked for


class SyntheticDrive:
    """A drive through a generated street; the same settings give the same pixels.

    Args:
        config: size, seed, noise, haze; ``num_frames`` and ``step_m`` of the generated loop.
        world_from_cam: (N, 4, 4) another path, metres, 1.65 m above its road; None: a loop.
            Where it comes by twice at two heights, it is levelled: ``info.truth`` has the result.
        name: of the sequence.

    Raises:
        DatasetError: the path is no path, or crosses itself on a bridge.
        DependencyError: Open3D cannot be loaded.
    """

    def __init__(
        self,
        config: SyntheticConfig,
        world_from_cam: Array | None = None,
        name: str = "synthetic",
    ) -> None:
        if world_from_cam is None:
            path = loop_path(config.num_frames, config.step_m, config.seed)
        else:
            path = path_from_kitti_poses(world_from_cam)
        self._config = config
        size = (config.height, config.width)
        focal = config.focal * config.width
        intrinsics = intrinsics_matrix(
            focal, focal, (config.width - 1) / 2, (config.height - 1) / 2
        )
        world = build_world(path, config.seed, config.haze)
        self._world_from_cam = path = world.world_from_cam
        self._renderer = Renderer(world, intrinsics, size)
        frames = np.arange(len(path), dtype=np.int64)
        self._info = SequenceInfo(
            name=name,
            size=size,
            num_frames=len(path),
            intrinsics=intrinsics,
            intrinsics_source="the generated camera",
            truth=Trajectory(frames, frames / FRAME_RATE_HZ, path),
        )

    @classmethod
    def from_poses_file(cls, path: Path, config: SyntheticConfig) -> SyntheticDrive:
        """Drive along a trajectory file in KITTI's format, such as ``poses/00.txt``.

        Raises:
            DatasetError: the file is missing or no trajectory.
        """
        return cls(config, read_kitti_poses(path), f"synthetic-{path.stem}")

    @property
    def info(self) -> SequenceInfo:
        """Say size, intrinsics and truth of the drive."""
        return self._info

    def frames(self) -> Generator[Frame, None, None]:
        """Render the frames in order, a few ahead of the reader."""
        num = len(self._world_from_cam)
        pool = ThreadPoolExecutor(WORKERS, thread_name_prefix="render")
        waiting: deque[Future[Image]] = deque()
        try:
            for frame in range(num):
                for ahead in range(frame + len(waiting), min(frame + AHEAD, num)):
                    waiting.append(pool.submit(self.image, ahead))
                yield Frame(frame, frame / FRAME_RATE_HZ, waiting.popleft().result())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def image(self, frame: int) -> Image:
        """Render one frame, (H, W, 3) RGB uint8; the order of the calls does not matter."""
        rng = np.random.default_rng((self._config.seed, 6, self._checked(frame)))
        image: Image = self._renderer.image(self._world_from_cam[frame], self._config.noise, rng)
        return image

    def true_depth(self, frame: int) -> NDArray[np.float32]:
        """Return the (H, W) depth z in metres of a frame; NaN: sky."""
        return self._renderer.depth(self._world_from_cam[self._checked(frame)])

    def _checked(self, frame: int) -> int:
        if not 0 <= frame < len(self._world_from_cam):
            raise DatasetError(
                f"the drive has frames 0 to {len(self._world_from_cam) - 1}, not {frame}"
            )
        return frame
