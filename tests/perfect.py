"""Networks that know the corridor: the truth, put the way that each network would say it."""

from typing import Any

import numpy as np
import torch
from corridor import DISTANCES, NORMALS, true_pose
from numpy.typing import NDArray
from torch import Tensor

from laser_slam.backbones.pi3 import Pi3Backbone
from laser_slam.backbones.pi3x import Pi3XBackbone
from laser_slam.backbones.vggt import VggtBackbone
from laser_slam.camera import intrinsics_matrix, rays
from laser_slam.config import BackboneConfig, load_config
from laser_slam.networks.pi3 import Pi3Output
from laser_slam.networks.pi3x import Conditions, Pi3XOutput
from laser_slam.networks.vggt import VggtOutput
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Prediction

Array = NDArray[np.float64]

SIZE = (70, 126)  # of the corridor's images, in whole patches
FOCALS = (75.1, 73.8)  # of the corridor's camera at this size
CONFIDENCE = 0.8


def camera(centre: tuple[float, float]) -> Array:
    return intrinsics_matrix(*FOCALS, *centre)


def true_depth(frame: int, K: Array) -> Array:
    """Return (H, W) z in metres of the corridor's planes."""
    world_from_cam = true_pose(frame)
    directions = rays(K, *SIZE) @ world_from_cam[:3, :3].T
    gap = DISTANCES - NORMALS @ world_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        depths = gap / (directions @ NORMALS.T)
    return np.asarray(np.where(depths > 0, depths, np.inf).min(axis=-1))


def seen(frames: NDArray[np.int64], K: Array) -> tuple[Array, Array]:
    """Return (N, H, W) depth in metres and (N, 4, 4) world_from_cam."""
    depth = np.stack([true_depth(int(frame), K) for frame in frames])
    return depth, np.stack([true_pose(int(frame)) for frame in frames])


def window_of(frames: NDArray[np.int64], unit_m: float) -> Sim3:
    """Return window_from_world of a window with axes and a unit of its own."""
    rng = np.random.default_rng(int(frames[0]))
    return Sim3(1 / unit_m, rotation_exp(rng.normal(size=3)), rng.normal(size=3))


class PerfectPi3:
    """Camera points, logits, camera-to-window poses; the window's frame is nobody's."""

    frames: NDArray[np.int64]
    told: Conditions | None = None

    def to(self, device: torch.device) -> Any:
        return self

    def state_dict(self) -> dict[str, Tensor]:
        return {"truth": torch.ones(1)}

    def points(self, unit_m: float, centre: tuple[float, float]) -> tuple[Tensor, ...]:
        K = camera(centre)
        depth, world_from_cam = seen(self.frames, K)
        points = rays(K, *SIZE) * depth[..., None] / unit_m
        poses = window_of(self.frames, unit_m).apply_poses(world_from_cam)
        logits = np.full(depth.shape, np.log(CONFIDENCE / (1 - CONFIDENCE)))
        tokens = np.random.default_rng(1).normal(size=(len(self.frames), 32))
        return tuple(torch.from_numpy(a)[None].float() for a in (points, logits, poses, tokens))

    def __call__(self, images: Tensor) -> Pi3Output:
        assert images.shape == (1, len(self.frames), 3, *SIZE)
        unit_m = float(np.random.default_rng(int(self.frames[0])).uniform(0.5, 8))
        return Pi3Output(*self.points(unit_m, ((SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2)))


class PerfectPi3X(PerfectPi3):
    """Metric; its points lie on rays about the principal point that it was told of."""

    def __call__(self, images: Tensor, conditions: Conditions | None = None) -> Any:
        self.told = conditions
        centre = ((SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2)
        if conditions is not None and conditions.intrinsics is not None:
            K = conditions.intrinsics[0, 0]
            centre = (float(K[0, 2]), float(K[1, 2]))
        local, logits, poses, tokens = self.points(1.0, centre)
        return Pi3XOutput(local, logits, poses, tokens, torch.ones(1))


class PerfectVggt(PerfectPi3):
    """Depth, world-to-camera poses from the first camera, one noisy camera for each frame."""

    def __call__(self, images: Tensor) -> Any:
        K = camera((SIZE[1] / 2, SIZE[0] / 2))
        depth, world_from_cam = seen(self.frames, K)
        first_from_cam = np.linalg.inv(world_from_cam[0]) @ world_from_cam
        first_from_cam[:, :3, 3] /= 7.0
        cameras = np.tile(K, (len(self.frames), 1, 1))
        jitter = 1 + 0.02 * (np.arange(len(self.frames)) % 3 - 1)  # its median is 1
        cameras[:, [0, 1], [0, 1]] *= jitter[:, None]
        said = (
            depth / 7.0,
            np.full(depth.shape, 1 / (1 - CONFIDENCE)),
            np.linalg.inv(first_from_cam),
            cameras,
            np.random.default_rng(1).normal(size=(len(self.frames), 32)),
        )
        return VggtOutput(*(torch.from_numpy(np.asarray(a))[None].float() for a in said))


SETTINGS = [f"backbone.{name}.side=126" for name in ("pi3", "pi3x", "vggt")]
SETTINGS += [f"backbone.{name}.dtype=float32" for name in ("pi3", "pi3x", "vggt")]
SETTINGS += [f"backbone.{name}.device=cpu" for name in ("pi3", "pi3x", "vggt")]
MAKERS = {
    "pi3": (Pi3Backbone, PerfectPi3),
    "pi3x": (Pi3XBackbone, PerfectPi3X),
    "vggt": (VggtBackbone, PerfectVggt),
}


def settings(*more: str) -> BackboneConfig:
    return load_config(assignments=[*SETTINGS, *more]).backbone


class Knowing:
    """A backbone around a perfect network, which it tells of the frames."""

    def __init__(self, name: str, *more: str) -> None:
        backbone, network = MAKERS[name]
        self.network = network()
        self.backbone: Any = backbone(settings(*more), self.network)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.backbone, name)

    def predict(
        self, images: Any, frames: NDArray[np.int64], intrinsics: Array | None
    ) -> Prediction:
        self.network.frames = frames
        prediction: Prediction = self.backbone.predict(images, frames, intrinsics)
        return prediction
