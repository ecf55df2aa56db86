"""Tracks of a drive without images: random points along a path, projected by known poses."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.reconstruction import collect
from laser_slam.backbones.classical.tracking import FrameTracks
from laser_slam.camera import distort, intrinsics_matrix
from laser_slam.sim3 import Array, rotation_exp

SIZE = (376, 1240)
NEAR_M, FAR_M = 3.0, 60.0


def true_camera(focal: float = 720.0) -> Array:
    return intrinsics_matrix(focal, focal, (SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2)


@dataclass(frozen=True)
class Drive:
    """A camera that drives a bend between random points; frame 0 is the world."""

    num_frames: int = 12
    turn_deg: float = 0.0
    step_m: float = 0.9
    noise_px: float = 0.3
    outliers: float = 0.0
    intrinsics: Array = field(default_factory=true_camera)
    distortion: Array = field(default_factory=lambda: np.zeros(4))
    num_points: int = 2500
    seed: int = 0

    @cached_property
    def rotations(self) -> Array:
        """cam_from_world."""
        yaw = np.radians(self.turn_deg) * np.linspace(0, 1, self.num_frames)
        return np.asarray(rotation_exp(np.stack([0 * yaw, -yaw, 0 * yaw], axis=1)))

    @cached_property
    def centres(self) -> Array:
        headings = self.rotations[:, 2]
        steps = self.step_m * 0.5 * (headings[1:] + headings[:-1])
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    @cached_property
    def translations(self) -> Array:
        return np.asarray(-np.einsum("cij,cj->ci", self.rotations, self.centres))

    @cached_property
    def points(self) -> Array:
        rng = np.random.default_rng(self.seed)
        x, z = rng.uniform(-25, 25, self.num_points), rng.uniform(-2, 45, self.num_points)
        points = np.stack([x, rng.uniform(-6, 1.7, self.num_points), z], axis=1)
        ahead = slice(self.num_points // 2)
        points[ahead] = points[ahead] @ self.rotations[-1] + self.centres[-1]
        return np.asarray(points)

    def true_pixels(self, frame: int) -> tuple[Array, Array]:
        """Return (P, 2) pixels and (P,) depths of all points."""
        in_camera = self.points @ self.rotations[frame].T + self.translations[frame]
        z = in_camera[:, 2]
        slopes = in_camera[:, :2] / np.where(np.abs(z) < 1e-9, 1e-9, z)[:, None]
        focal = self.intrinsics[[0, 1], [0, 1]]
        return distort(slopes, self.distortion) * focal + self.intrinsics[:2, 2], z

    @cached_property
    def views(self) -> list[FrameTracks]:
        rng = np.random.default_rng(self.seed + 1)
        blank = np.zeros(SIZE, np.uint8)
        out = []
        for frame in range(self.num_frames):
            pixels, z = self.true_pixels(frame)
            inside = np.all((pixels > 0) & (pixels < [SIZE[1] - 1, SIZE[0] - 1]), axis=1)
            ids = np.flatnonzero(inside & (z > NEAR_M) & (z < FAR_M))
            noise = rng.normal(0, self.noise_px, (len(ids), 2)) if self.noise_px else 0.0
            wrong = rng.uniform(size=(len(ids), 1)) < self.outliers
            noise = noise + wrong * rng.uniform(-30, 30, (len(ids), 2))
            out.append(FrameTracks(frame, blank, ids, pixels[ids] + noise))
        return out

    def bundle(self, fixed: tuple[int, ...] = ()) -> tuple[Bundle, NDArray[np.int64]]:
        """Return all tracks with the true poses and points, and the numbers of the points."""
        seen = collect(self.views)
        is_fixed = np.isin(np.arange(self.num_frames), fixed)
        K, points = self.intrinsics, self.points[seen.ids]
        flat = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.distortion])
        poses = self.rotations.copy(), self.translations.copy()
        return (
            Bundle(*poses, points, seen.cameras, seen.starts, seen.pixels, is_fixed, flat),
            seen.ids,
        )


def camera_centres(rotations: Array, translations: Array) -> Array:
    return np.asarray(-np.einsum("cji,cj->ci", rotations, translations))
