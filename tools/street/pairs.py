"""Two windows of a street as a network might distort them, with the truth of every frame.

The depth of the second window is the truth times a factor per object, per band of depth or per
depth, seen from a Sim(3) frame of its own; both windows carry noise, smeared edges and outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from laser_slam.sim3 import Sim3, rotation_exp, rotation_log
from laser_slam.types import Image, Prediction
from street.noise import confidence, outliers, smear, smooth_noise
from street.world import SKY, SKY_M, Drive, build_world, drive_through

Array = NDArray[np.float64]
Factors = Literal["rigid", "objects", "bands", "smooth"]

WINDOW, OVERLAP = 20, 5  # frames
KITTI_SIZE, TALL_SIZE = (154, 518), (294, 518)  # height, width at which networks work
MAX_FACTOR = 1.25  # factors lie between its inverse and it
_NUM_BANDS = 6
_BAND_EDGES_M = np.geomspace(9.0, 30.0, _NUM_BANDS - 1)
_CLOSEST_M = 4.0  # what the camera sees just before the bonnet
_DRAW = 6  # of factors: the first three seeds together are as hard as an average draw


@dataclass(frozen=True)
class Case:
    """One way to distort.

    Attributes:
        factors: what the factors of the second window follow.
        noise: standard deviation of log-depth; smooth and independent noise in equal parts.
        outliers: share of the pixels that lie in blobs of wrong depth.
        blur_px: width of the smear at depth edges.
        pose_deg: noise of each axis of the rotations.
        pose_m: noise of each coordinate of the camera centres, metres.
        unit: units per metre of the first window.
        outlier_confidence: factor on the confidence of outliers; 1: the network has no idea.
    """

    factors: Factors = "rigid"
    noise: float = 0.01
    outliers: float = 0.0
    blur_px: float = 0.8
    pose_deg: float = 0.05
    pose_m: float = 0.02
    unit: float = 0.1
    outlier_confidence: float = 1.0


CASES: dict[str, Case] = {
    "rigid, no noise": Case(noise=0.0, pose_deg=0.0, pose_m=0.0),
    "rigid, noise 1 %": Case(),
    "rigid, noise 3 %": Case(noise=0.03),
    "rigid, noise 5 %": Case(noise=0.05),
    "rigid, noise 10 %": Case(noise=0.1),
    "rigid, outliers 10 %": Case(outliers=0.1),
    "rigid, outliers 30 %": Case(outliers=0.3),
    "rigid, pose noise": Case(pose_deg=0.5, pose_m=0.2),
    "objects, noise 1 %": Case("objects"),
    "objects, noise 3 %": Case("objects", noise=0.03),
    "objects, noise 10 %": Case("objects", noise=0.1),
    "objects, outliers 10 %": Case("objects", outliers=0.1),
    "objects, outliers 30 %": Case("objects", outliers=0.3),
    "6 depth bands": Case("bands"),
    "smooth in log depth": Case("smooth"),
    "objects, blurred 3 px": Case("objects", blur_px=3.0),
}


@dataclass(frozen=True)
class Pair:
    """Two windows that share ``OVERLAP`` frames, and the truth.

    Attributes:
        previous: the first window: the truth with noise.
        current: the second: the truth times ``factors``, with noise.
        drive: the truth of all frames, in metres.
        factors: (20, H, W) of the second window; their median without the sky is 1.
        previous_from_current: the true Sim(3); with factors its scale is a convention.
        unit: units per metre of the first window.
    """

    previous: Prediction
    current: Prediction
    drive: Drive
    factors: Array
    previous_from_current: Sim3
    unit: float

    def truth(self, window: Prediction) -> Array:
        """Return the (20, H, W) true depth of a window's frames, in units of the first window."""
        return self.drive.depth[window.frames] * self.unit

    def ids(self, window: Prediction) -> NDArray[np.int64]:
        """Return the (20, H, W) objects of a window's pixels."""
        return self.drive.ids[window.frames]

    def colors(self, window: Prediction) -> Image:
        """Paint every object in one colour: (20, H, W, 3) RGB."""
        palette = np.random.default_rng(0).integers(40, 256, (self.drive.num_objects, 3))
        return palette.astype(np.uint8)[self.ids(window)]


@dataclass(frozen=True)
class Errors:
    """How far a window is from the truth, without the sky.

    Attributes:
        overlap: mean of |depth - truth| / truth over the shared frames.
        new: the same over the other frames.
        layer_overlap: |log| of the median ratio of an object in a frame, weighted by its area.
        layer_new: the same over the other frames.
    """

    overlap: float
    new: float
    layer_overlap: float
    layer_new: float


@lru_cache(maxsize=4)
def true_drive(seed: int, size: tuple[int, int]) -> Drive:
    """See the street of a seed; the same for all cases."""
    rng = np.random.default_rng([seed, 0])
    return drive_through(build_world(rng), rng, 2 * WINDOW - OVERLAP, size)


def make_pair(case: Case, seed: int, size: tuple[int, int] = KITTI_SIZE) -> Pair:
    """Distort the street of a seed as a case says.

    Args:
        case: the strengths.
        seed: of street, Sim(3), factors and noise.
        size: (height, width) of the depth maps.
    """
    drive = true_drive(seed, size)
    rng = np.random.default_rng([seed, 1])
    scale, turn = float(np.exp(rng.uniform(-0.4, 0.4))), rng.uniform(-1.5, 1.5, 3)
    previous_from_current = Sim3(scale, rotation_exp(turn), case.unit * rng.uniform(-10, 10, 3))
    previous_from_world = Sim3(case.unit)
    current_from_world = previous_from_current.inverse() @ previous_from_world
    first, second = np.arange(WINDOW), np.arange(WINDOW - OVERLAP, 2 * WINDOW - OVERLAP)
    factors = _factors(case.factors, drive, second, np.random.default_rng([seed, _DRAW]))
    previous = _distort(drive, first, np.ones_like(factors), previous_from_world, case, seed)
    current = _distort(drive, second, factors, current_from_world, case, seed)
    return Pair(previous, current, drive, factors, previous_from_current, case.unit)


def score(pair: Pair, current: Prediction, scale: float) -> Errors:
    """Compare the second window with the truth.

    Args:
        pair: the truth.
        current: the second window, corrected or not.
        scale: units of the first window per unit of the second, as registration found it.
    """
    truth, ids = pair.truth(current), pair.ids(current)
    ratio = scale * current.depth.astype(np.float64) / truth
    figures = []
    for part in (slice(None, OVERLAP), slice(OVERLAP, None)):
        figures += [_abs_rel(ratio[part], ids[part]), _layer_error(ratio[part], ids[part])]
    return Errors(figures[0], figures[2], figures[1], figures[3])


def rotation_error_deg(pair: Pair, previous_from_current: Sim3) -> float:
    """Return the angle between a measured rotation and the true one."""
    gap = previous_from_current.rotation @ pair.previous_from_current.rotation.T
    return float(np.degrees(np.linalg.norm(rotation_log(gap))))


def _abs_rel(ratio: Array, ids: NDArray[np.int64]) -> float:
    return float(np.abs(ratio[ids != SKY] - 1).mean())


def _layer_error(ratio: Array, ids: NDArray[np.int64]) -> float:
    """Return the mean over pixels of what their object's median in their frame is off."""
    total, num = 0.0, 0
    for frame, objects in zip(ratio, ids, strict=True):
        order = np.argsort(objects, axis=None, kind="stable")
        names, starts = np.unique(objects.ravel()[order], return_index=True)
        parts = np.split(frame.ravel()[order], starts[1:])
        for values in (part for name, part in zip(names, parts, strict=True) if name != SKY):
            total += len(values) * abs(float(np.log(np.median(values))))
            num += len(values)
    return total / num


def _factors(
    kind: Factors, drive: Drive, frames: NDArray[np.int64], rng: np.random.Generator
) -> Array:
    """Return (20, H, W) factors, log-uniform, whose median without the sky is 1."""
    depth, ids = drive.depth[frames], drive.ids[frames]
    reach = np.log(MAX_FACTOR)
    if kind == "rigid":
        return np.ones_like(depth)
    if kind == "objects":
        logs = rng.uniform(-reach, reach, drive.num_objects)[ids]
    elif kind == "bands":
        logs = rng.uniform(-reach, reach, _NUM_BANDS)[np.digitize(depth, _BAND_EDGES_M)]
    else:
        waves = 2 * np.pi * np.log(depth / _CLOSEST_M) / np.log(SKY_M / _CLOSEST_M)
        logs = 0.9 * reach * np.sin(rng.uniform(0.8, 1.4) * waves + rng.uniform(0, 2 * np.pi))
    logs -= np.median(logs[ids != SKY])
    return np.exp(logs)


def _distort(
    drive: Drive,
    frames: NDArray[np.int64],
    factors: Array,
    window_from_world: Sim3,
    case: Case,
    seed: int,
) -> Prediction:
    """Predict some frames of the drive, badly: one window in its own frame and unit."""
    rng = np.random.default_rng([seed, 3, int(frames[0])])
    truth = drive.depth[frames]
    pairs = [smear(depth, case.blur_px) for depth in truth * factors]
    depth, is_edge = (np.stack(part) for part in zip(*pairs, strict=True))
    wrong = outliers(truth.shape, case.outliers, rng)
    noise = np.sqrt(0.5) * (smooth_noise(truth.shape, rng) + rng.normal(size=truth.shape))
    depth = window_from_world.scale * depth * np.exp(wrong + case.noise * noise)
    trust = confidence(truth, is_edge, drive.ids[frames] == SKY, rng)
    trust[wrong != 0] *= case.outlier_confidence
    world_from_cam = drive.world_from_cam[frames].copy()
    turns = np.radians(case.pose_deg) * rng.normal(size=(len(frames), 3))
    world_from_cam[:, :3, :3] = world_from_cam[:, :3, :3] @ rotation_exp(turns)
    world_from_cam[:, :3, 3] += case.pose_m * rng.normal(size=(len(frames), 3))
    return Prediction(
        frames=frames,
        depth=depth.astype(np.float32),
        confidence=trust.astype(np.float32),
        window_from_cam=window_from_world.apply_poses(world_from_cam),
        intrinsics=np.tile(drive.intrinsics, (len(frames), 1, 1)),
    )
