"""A generated street and a ray caster that knows its exact depth and objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import guess_intrinsics
from laser_slam.camera import rays as camera_rays
from laser_slam.sim3 import rotation_exp
from street.ray_kernels import cast_boxes, cast_poles

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

SKY, GROUND = 0, 1  # ids; everything else stands on the ground and counts from 2
SKY_M = 150.0
CAMERA_HEIGHT_M = 1.65
STEP_M = 0.8
_FOCAL = 0.58  # image widths
_END_M = 200.0  # how far the street is built
_CORNERS = np.array([[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)])


@dataclass(frozen=True)
class World:
    """What stands in a street, in metres; x right, y down, z along the street.

    Attributes:
        boxes: (B, 6) corners x, y, z, first the lower ones, then the upper ones.
        box_ids: (B,) to which object each belongs; a car may be two boxes.
        poles: (P, 4) upright cylinders: centre x and z, radius, y of the top.
        pole_ids: (P,) objects.
        num_objects: ids run from 0 (``SKY``) and 1 (``GROUND``) to this, exclusively.
    """

    boxes: Array
    box_ids: Ids
    poles: Array
    pole_ids: Ids
    num_objects: int


@dataclass(frozen=True)
class Drive:
    """What the camera truly sees along the street.

    Attributes:
        depth: (N, H, W) z in metres; the sky at ``SKY_M``.
        ids: (N, H, W) object of each pixel.
        world_from_cam: (N, 4, 4) rigid, in metres.
        intrinsics: (3, 3) in pixels.
        num_objects: as in the world.
    """

    depth: Array
    ids: Ids
    world_from_cam: Array
    intrinsics: Array
    num_objects: int


def build_world(rng: np.random.Generator) -> World:
    """Line a street with houses, parked cars, poles and one van."""
    boxes: list[list[float]] = []
    box_ids: list[int] = []
    num = GROUND + 1
    for side in (-1, 1):
        for solid in (*_houses(rng, side), *_cars(rng, side)):
            boxes += solid
            box_ids += [num] * len(solid)
            num += 1
    side = int(rng.choice([-1, 1]))
    boxes.append(_box(side, (3.0, 5.1), (z := rng.uniform(26, 40), z + 5.5), 2.4))
    box_ids.append(num)
    poles = _poles(rng)
    pole_ids = np.arange(num + 1, num + 1 + len(poles))
    return World(np.array(boxes), np.array(box_ids), poles, pole_ids, num + 1 + len(poles))


def drive_through(
    world: World, rng: np.random.Generator, num_frames: int, size: tuple[int, int]
) -> Drive:
    """See the street from a car: 1.65 m up, 0.8 m a frame, swerving a little.

    Args:
        world: the street.
        rng: gives the phase of the swerving.
        num_frames: how many views.
        size: (height, width) in pixels.
    """
    intrinsics = guess_intrinsics(*size, _FOCAL)
    yaws = np.radians(5.0) * np.sin(np.arange(num_frames) * 0.2 + rng.uniform(0, 6.3))
    world_from_cam = np.tile(np.eye(4), (num_frames, 1, 1))
    world_from_cam[:, :3, :3] = rotation_exp(yaws[:, None] * np.array([0.0, 1.0, 0.0]))
    steps = STEP_M * world_from_cam[:-1, :3, 2]
    world_from_cam[1:, :3, 3] = np.cumsum(steps, axis=0)
    depth = np.empty((num_frames, *size))
    ids = np.empty((num_frames, *size), dtype=np.int64)
    for frame, pose in enumerate(world_from_cam):
        _cast(world, pose, intrinsics, depth[frame], ids[frame])
    return Drive(depth, ids, world_from_cam, intrinsics, world.num_objects)


def _box(
    side: int, aside: tuple[float, float], along: tuple[float, float], top: float
) -> list[float]:
    """Return a box between two distances from the street's middle, on the ground."""
    x = sorted(side * distance for distance in aside)
    return [x[0], CAMERA_HEIGHT_M - top, along[0], x[1], CAMERA_HEIGHT_M, along[1]]


def _houses(rng: np.random.Generator, side: int) -> list[list[list[float]]]:
    """Build houses wall to wall, each with a setback of its own."""
    out, z = [], -10.0
    while z < _END_M:
        length, aside = rng.uniform(8, 16), rng.uniform(7, 13)
        out.append([_box(side, (aside, aside + 14), (z, z + length), rng.uniform(7, 16))])
        z += length
    return out


def _cars(rng: np.random.Generator, side: int) -> list[list[list[float]]]:
    """Park cars at the kerb, two thirds of them with a cabin on the body."""
    out, z = [], rng.uniform(-2, 8)
    while z < 120:
        aside, length, top = rng.uniform(4.2, 5.0), rng.uniform(3.6, 4.8), rng.uniform(1.35, 1.7)
        rear = aside + 1.75
        if rng.random() < 0.67:
            cabin = _box(side, (aside + 0.15, rear - 0.15), (z + 0.8, z + length - 0.9), top)
            out.append([_box(side, (aside, rear), (z, z + length), 0.6 * top), cabin])
        else:
            out.append([_box(side, (aside, rear), (z, z + length), top)])
        z += length + rng.uniform(1, 14)
    return out


def _poles(rng: np.random.Generator) -> Array:
    """Set lamp posts on both pavements."""
    z = np.arange(5.0, 120.0, 12.0)
    z = np.concatenate([z, z + 6.0]) + rng.uniform(-2, 2, 2 * len(z))
    x = np.repeat([-6.4, 6.4], len(z) // 2)
    return np.stack([x, z, rng.uniform(0.08, 0.16, len(z)), CAMERA_HEIGHT_M - 6.5 + 0 * z], axis=1)


def _columns(corners: Array, world_from_cam: Array, intrinsics: Array, width: int) -> Ids:
    """Return the (S, 2) first and last column + 1 that solids of (S, C, 3) corners may cover."""
    cam = (corners - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
    is_ahead = cam[..., 2] > 0.1
    slopes = cam[..., 0] / np.where(is_ahead, cam[..., 2], 1.0)
    # What reaches behind the camera covers all columns on its side; all behind covers none.
    slopes = np.where(is_ahead, slopes, np.sign(cam[..., 0]) * np.inf)
    slopes[~is_ahead.any(axis=1)] = np.inf
    columns = slopes * intrinsics[0, 0] + intrinsics[0, 2]
    first, last = np.floor(columns.min(axis=1)), np.ceil(columns.max(axis=1)) + 1
    covered: Ids = np.clip(np.stack([first, last], axis=1), 0, width).astype(np.int64)
    return covered


def _cast(world: World, world_from_cam: Array, intrinsics: Array, depth: Array, ids: Ids) -> None:
    """Fill (H, W) depth and ids: rays have z = 1 in camera axes, so their length is depth."""
    rays = camera_rays(intrinsics, *depth.shape) @ world_from_cam[:3, :3].T
    origin = world_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        ground = (CAMERA_HEIGHT_M - origin[1]) / rays[..., 1]
    is_ground = (ground > 0) & (ground < SKY_M)
    depth[:], ids[:] = np.where(is_ground, ground, SKY_M), np.where(is_ground, GROUND, SKY)
    corners = world.boxes[:, _CORNERS]
    columns = _columns(corners, world_from_cam, intrinsics, depth.shape[1])
    cast_boxes(world.boxes, world.box_ids, columns, origin, rays, depth, ids)
    x, z, radius, top = world.poles.T
    flat = np.stack([x - radius, top, z - radius, x + radius, 0 * x + CAMERA_HEIGHT_M, z + radius])
    columns = _columns(flat.T[:, _CORNERS], world_from_cam, intrinsics, depth.shape[1])
    cast_poles(world.poles, world.pole_ids, columns, origin, rays, depth, ids)
