"""A drive in circles through a room with analytic depth, seen by windows that drift."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_from_fov, rays
from laser_slam.config import Config
from laser_slam.sim3 import Sim3, rotation_exp, umeyama
from laser_slam.slam import Slam
from laser_slam.types import Image, Prediction, Trajectory, WindowStatus

Array = NDArray[np.float64]

SIZE = (24, 40)
LAP, RADIUS_M = 90, 12.0  # frames
WINDOW, OVERLAP = 8, 3
NUM_WINDOWS = 23  # one lap and a quarter
NUM_FRAMES = NUM_WINDOWS * (WINDOW - OVERLAP) + OVERLAP
TIMES_S = np.arange(2 * NUM_FRAMES) / 10.0
# Planes n . p = d of the room, in metres: floor, ceiling, four walls.
NORMALS = np.array([[0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1.0]])
DISTANCES = np.array([1.6, 2.4, 2 * RADIUS_M + 6, 6, RADIUS_M + 6, RADIUS_M + 6])
SIGMAS = np.repeat([2e-3, 2e-2, 5e-3], [3, 3, 1])  # of a closure, translation in median depths


@dataclass(frozen=True)
class Drift:
    """What a window gets wrong from frame to frame; sigmas, one draw for each window."""

    turn_deg: float = 0.15
    growth: float = 0.004
    seed: int = 0


NO_DRIFT = Drift(0.0, 0.0)


def ring_pose(frame: int) -> Array:
    """Return world_from_cam in metres: round and round, looking ahead."""
    angle = 2 * np.pi * frame / LAP
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = rotation_exp(np.array([0.0, angle, 0.0]))
    world_from_cam[:3, 3] = RADIUS_M * np.array([1 - np.cos(angle), 0.0, np.sin(angle)])
    return world_from_cam


def ring_depth(frame: int) -> NDArray[np.float32]:
    """Return the (H, W) depth z of the room in metres."""
    world_from_cam = ring_pose(frame)
    directions = rays(intrinsics_from_fov(80.0, *SIZE), *SIZE) @ world_from_cam[:3, :3].T
    with np.errstate(divide="ignore"):
        depths = (DISTANCES - NORMALS @ world_from_cam[:3, 3]) / (directions @ NORMALS.T)
    return np.asarray(np.where(depths > 0, depths, np.inf).min(axis=-1), np.float32)


MEDIAN_M = float(np.median(ring_depth(0)))


def ring_prediction(
    frames: NDArray[np.int64],
    unit_m: float = 1.0,
    drift: Drift = NO_DRIFT,
    status: WindowStatus = WindowStatus.OK,
) -> Prediction:
    """See a window in its first camera's frame, turning and growing as it goes on."""
    num = len(frames)
    intrinsics = np.tile(intrinsics_from_fov(80.0, *SIZE), (num, 1, 1))
    window_from_cam = np.tile(np.eye(4), (num, 1, 1))
    if status is not WindowStatus.OK:
        nothing = np.full((num, *SIZE), np.nan, np.float32)
        confidence = np.zeros_like(nothing)
        return Prediction(frames, nothing, confidence, window_from_cam, intrinsics, status)
    rng = np.random.default_rng((drift.seed, int(frames[0])))
    turn, growth = rng.normal(size=2) * [np.radians(drift.turn_deg), drift.growth]
    grown = np.exp(growth * np.arange(num)) / unit_m
    world_from_cam = np.stack([ring_pose(int(frame)) for frame in frames])
    for i in range(1, num):
        step = np.linalg.inv(world_from_cam[i - 1]) @ world_from_cam[i]
        step[:3, :3] = step[:3, :3] @ rotation_exp(np.array([0.0, turn, 0.0]))
        step[:3, 3] *= grown[i]
        window_from_cam[i] = window_from_cam[i - 1] @ step
    depth = np.stack([ring_depth(int(frame)) for frame in frames])
    depth = (depth * grown[:, None, None]).astype(np.float32)
    confidence = np.full(depth.shape, 0.9, np.float32)
    confidence[:, : SIZE[0] // 2] = 0.7
    return Prediction(frames, depth, confidence, window_from_cam, intrinsics)


def frames_of(window: int) -> NDArray[np.int64]:
    """Return the frames of a window."""
    return window * (WINDOW - OVERLAP) + np.arange(WINDOW)


def unit_of(window: int, seed: int = 0) -> float:
    """Return the metres of a window's unit."""
    return float(np.random.default_rng((seed, window)).uniform(1.0, 6.0))


def prediction_of(
    window: int, drift: Drift = NO_DRIFT, status: WindowStatus = WindowStatus.OK
) -> Prediction:
    """See a window of the drive, in a unit of its own."""
    return ring_prediction(frames_of(window), unit_of(window, drift.seed), drift, status)


def black(num: int = WINDOW) -> Image:
    """Return images that nobody looks at."""
    return np.zeros((num, *SIZE, 3), np.uint8)


def chain(
    drift: Drift, num: int = NUM_WINDOWS, statuses: dict[int, WindowStatus] | None = None
) -> Slam:
    """Chain the windows of the drive, without closures."""
    slam = Slam(Config())
    for window in range(num):
        status = (statuses or {}).get(window, WindowStatus.OK)
        slam.add(prediction_of(window, drift, status), black())
    return slam


def true_link(a: int, b: int, seed: int = 0) -> tuple[Sim3, Array]:
    """Return the true a_from_b of two windows, and the sigmas of a good closure in a's units."""
    world_from_a, world_from_b = (
        Sim3.from_matrix(ring_pose(int(frames_of(window)[0]))) @ Sim3(unit_of(window, seed))
        for window in (a, b)
    )
    unit = MEDIAN_M / unit_of(a, seed)
    return world_from_a.inverse() @ world_from_b, SIGMAS * np.repeat([1.0, unit, 1.0], [3, 3, 1])


def ate_m(trajectory: Trajectory) -> float:
    """Return the rms distance to the truth after a Sim(3) alignment."""
    centres = trajectory.world_from_cam[:, :3, 3]
    truth = np.stack([ring_pose(int(frame))[:3, 3] for frame in trajectory.frames])
    offsets = umeyama(centres, truth).apply(centres) - truth
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))
