"""Boards before a wall: a scene whose layers, depth and scales are all known."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix, rays
from laser_slam.layers.segmenters import close_gaps
from laser_slam.types import Image, Prediction

Array = NDArray[np.float64]
Labels = NDArray[np.uint16]

WALL_M = 25.0


@dataclass(frozen=True)
class Window:
    """A prediction of some frames, and the truth of them.

    Attributes:
        prediction: with distorted depth, in a unit of its own.
        ids: (N, H, W) which board a pixel shows; 0: the wall.
        truth: (N, H, W) depth in metres.
        unit_m: metres that the prediction's unit is long.
    """

    prediction: Prediction
    ids: NDArray[np.int64]
    truth: Array
    unit_m: float

    def labels(self, block: int = 1) -> Labels:
        """Segment perfectly: each board is a layer."""
        return np.stack([close_gaps(ids[::block, ::block] + 1) for ids in self.ids])

    def log_error(self, depth: NDArray[np.float32]) -> Array:
        """Return the (N, H, W) logarithm by which a depth in this window's unit is too far."""
        return np.asarray(np.log(depth * self.unit_m / self.truth))

    @property
    def colors(self) -> Image:
        return np.zeros((*self.ids.shape, 3), np.uint8)


@dataclass
class Boards:
    """A camera slides sideways past boards that face it.

    Attributes:
        seed: of the boards.
        size: (height, width) in pixels.
        speed_m: metres from frame to frame.
        num: boards.
    """

    seed: int = 0
    size: tuple[int, int] = (48, 96)
    speed_m: float = 0.05
    num: int = 14
    boxes: Array = field(init=False)

    def __post_init__(self) -> None:
        """Put the boards (left, top, right, bottom, depth), the farthest first."""
        rng = np.random.default_rng([7, self.seed])
        z = np.sort(np.geomspace(4.0, 18.0, self.num))[::-1]
        center = rng.uniform([-0.75, -0.35], [0.75, 0.35], (self.num, 2)) * z[:, None]
        half = rng.uniform(0.06, 0.14, (self.num, 2)) * z[:, None]
        self.boxes = np.column_stack([center - half, center + half, z])

    @property
    def intrinsics(self) -> Array:
        height, width = self.size
        return intrinsics_matrix(0.6 * width, 0.6 * width, (width - 1) / 2, (height - 1) / 2)

    def view(self, frame: int) -> tuple[Array, NDArray[np.int64]]:
        """Return (H, W) depth in metres and which board is seen; 0: the wall."""
        slopes = rays(self.intrinsics, *self.size)
        x0 = self.speed_m * frame
        depth = np.full(self.size, WALL_M)
        ids = np.zeros(self.size, np.int64)
        for k, (left, top, right, bottom, z) in enumerate(self.boxes, 1):
            x, y = x0 + slopes[..., 0] * z, slopes[..., 1] * z
            inside = (x > left) & (x < right) & (y > top) & (y < bottom)
            depth[inside], ids[inside] = z, k
        return depth, ids

    def window(
        self,
        frames: NDArray[np.int64],
        factors: Array | None = None,
        noise: float = 0.0,
        unit_m: float = 1.0,
    ) -> Window:
        """Predict some frames.

        Args:
            frames: (N,) rising.
            factors: (num + 1,) on the depth of the wall and of each board; None: all 1.
            noise: standard deviation of log depth, each pixel for itself.
            unit_m: metres that the window's unit is long.
        """
        views = [self.view(int(frame)) for frame in frames]
        truth, ids = (np.stack(parts) for parts in zip(*views, strict=True))
        rng = np.random.default_rng([self.seed, int(frames[0]), len(frames)])
        depth = truth * np.exp(noise * rng.normal(size=truth.shape)) / unit_m
        if factors is not None:
            depth = depth * factors[ids]
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        poses[:, 0, 3] = self.speed_m * (frames - frames[0]) / unit_m
        prediction = Prediction(
            frames=frames,
            depth=depth.astype(np.float32),
            confidence=np.full(depth.shape, 0.8, np.float32),
            window_from_cam=poses,
            intrinsics=np.tile(self.intrinsics, (len(frames), 1, 1)),
        )
        return Window(prediction, ids, truth, unit_m)

    def random_factors(self, seed: int, sigma: float = 0.1) -> Array:
        """Draw a factor for the wall and for each board."""
        logs = np.random.default_rng([seed, 3]).normal(0, sigma, self.num + 1)
        return np.asarray(np.exp(logs.clip(-2 * sigma, 2 * sigma)))
