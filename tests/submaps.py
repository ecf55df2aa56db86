"""Small submaps with random poses, for fusion."""

import numpy as np

from laser_slam.camera import intrinsics_from_fov
from laser_slam.config import FusionConfig
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Prediction, Submap

SIZE = (24, 40)
EVERYTHING = FusionConfig(
    agreement=0.0,
    min_confidence=0.0,
    max_range=1e6,
    edge_jump=1e6,
    voxel_size=0.05,
    min_observations=1,
)


def submap_of(depth: np.ndarray, *, index: int = 0, seed: int = 0, unit: float = 1.0) -> Submap:
    """Make a submap with random poses, confidences and colours; the world keeps its unit."""
    rng = np.random.default_rng(seed)
    num, height, width = depth.shape
    window_from_cam = np.tile(np.eye(4), (num, 1, 1))
    window_from_cam[:, :3, :3] = [rotation_exp(0.1 * rng.normal(size=3)) for _ in range(num)]
    window_from_cam[:, :3, 3] = 0.2 * unit * rng.normal(size=(num, 3))
    confidence = np.where(np.isfinite(depth), rng.uniform(0.1, 1, depth.shape), 0)
    intrinsics = np.tile(intrinsics_from_fov(70, height, width), (num, 1, 1))
    rotation = rotation_exp(rng.normal(size=3))
    return Submap(
        index=index,
        prediction=Prediction(
            frames=index * num + np.arange(num),
            depth=(unit * depth).astype(np.float32),
            confidence=confidence.astype(np.float32),
            window_from_cam=window_from_cam,
            intrinsics=intrinsics,
        ),
        colors=rng.integers(0, 256, (*depth.shape, 3), dtype=np.uint8),
        world_from_window=Sim3(1.7 / unit, rotation, rng.normal(size=3)),
        is_owned=np.ones(num, dtype=bool),
        registration=None,
    )


def wavy_depth(num: int = 3, seed: int = 0, holes: float = 0.1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    waves = [2 + np.sin(u / 9 + i) * np.cos(v / 7) + 0.02 * v for i in range(num)]
    depth = np.array(waves, np.float32)
    depth[rng.random(depth.shape) < holes] = np.nan
    return depth
