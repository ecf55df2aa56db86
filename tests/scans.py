"""A street of boxes whose every depth and motion is known, with a laser scanner beside a camera."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from image_files import write_png
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix, rays
from laser_slam.sim3 import rotation_exp

Array = NDArray[np.float64]

SIZE = (120, 400)
INTRINSICS = intrinsics_matrix(240.0, 240.0, 199.5, 55.0)
BASELINE_M = 0.5  # of the second camera to the right of the first: more than KITTI's, to be seen
GROUND_M = 1.65
NUM = 12
NUM_COLUMNS = 720  # of the scanner's turn

_RNG = np.random.default_rng(4)


def _boxes() -> tuple[Array, Array]:
    """Draw boxes on both sides of the road, cars on it, and a wall at its end."""
    z = np.repeat(np.arange(-30.0, 60.0, 6.0), 2)
    side = np.tile([-1.0, 1.0], len(z) // 2)
    x = side * _RNG.uniform(5.0, 9.0, len(z))
    half = np.stack([_RNG.uniform(0.7, 2.5, len(z)) for _ in range(3)], axis=1)
    center = np.stack([x, GROUND_M - half[:, 1], z + _RNG.uniform(-2, 2, len(z))], axis=1)
    cars = np.array([[-3.2, 0.95, 16.0], [3.2, 0.95, 24.0]]), np.array([[0.9, 0.7, 2.0]] * 2)
    wall = np.array([[0.0, -3.0, 70.0]]), np.array([[30.0, 5.0, 1.0]])
    centers = np.concatenate([center, cars[0], wall[0]])
    halves = np.concatenate([half, cars[1], wall[1]])
    return centers - halves, centers + halves


LOWS, HIGHS = _boxes()


def true_pose(frame: float) -> Array:
    """Return world_from_cam0: from rest to a metre a frame, along a gentle bend."""
    ahead_m = np.hypot(frame, 6.0) - 6.0
    out = np.eye(4)
    out[:3, :3] = rotation_exp(np.array([0.0, 0.012 * ahead_m, 0.0]))
    out[:3, 3] = [0.006 * ahead_m**2, 0.0, ahead_m]
    return out


def cam0_from_velo() -> Array:
    """Return where KITTI's scanner sits, a little turned."""
    out = np.eye(4)
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    out[:3, :3] = rotation_exp(np.array([0.01, -0.015, 0.005])) @ axes
    out[:3, 3] = [-0.01, -0.4, -0.3]
    return out


def cam0_from_cam() -> Array:
    out = np.eye(4)
    out[0, 3] = BASELINE_M
    return out


def cast(origins: Array, directions: Array) -> Array:
    """Return how many (..., 3) directions away from their origins the world begins; inf: sky."""
    origin = [origins[..., axis] for axis in range(3)]  # one axis at a time is much faster
    with np.errstate(divide="ignore", invalid="ignore"):
        per_way = [1 / np.ascontiguousarray(directions[..., axis]) for axis in range(3)]
        ground = (GROUND_M - origin[1]) * per_way[1]
        far = np.where(ground > 0, ground, np.inf)
        for low, high in zip(LOWS, HIGHS, strict=True):
            enter, leave = np.float64(-np.inf), np.float64(np.inf)
            for axis in range(3):
                one = (low[axis] - origin[axis]) * per_way[axis]
                other = (high[axis] - origin[axis]) * per_way[axis]
                enter = np.maximum(enter, np.minimum(one, other))
                leave = np.minimum(leave, np.maximum(one, other))
            far = np.where((enter > 0) & (enter < leave), np.minimum(far, enter), far)
    return np.asarray(far)


def true_depth(frame: int) -> Array:
    """Return the (H, W) depth of the second camera."""
    world_from_cam = true_pose(frame) @ cam0_from_cam()
    directions = rays(INTRINSICS, *SIZE) @ world_from_cam[:3, :3].T
    return cast(world_from_cam[:3, 3], directions)


def beams() -> Array:
    """Return (M, 3) directions in the scanner's axes."""
    elevation = np.radians(np.linspace(2.0, -24.8, 64))
    azimuth = np.linspace(-np.pi, np.pi, NUM_COLUMNS, endpoint=False)
    tilt, turn = (part.ravel() for part in np.meshgrid(elevation, azimuth, indexing="ij"))
    out = [np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)]
    return np.stack(out, axis=1)


def scan(frame: int) -> Array:
    """Return the (N, 3) points that the scanner sees, in its axes; it stands still meanwhile."""
    directions = beams()
    world_from_velo = true_pose(frame) @ cam0_from_velo()
    far = cast(world_from_velo[:3, 3], directions @ world_from_velo[:3, :3].T)
    seen = far < 80
    return np.asarray(directions[seen] * far[seen, None])


def landmarks(frame: int, *, turns_while_driving: bool = False) -> Array:
    """Return the same points of the world in the axes of the scanner, wherever it stands.

    Rings on a bare road tell a registration that nothing moved; these points tell all.

    Args:
        frame: of the scan.
        turns_while_driving: each point is seen as the scanner faces it, the front of the car in
            the middle of a turn; else all at once.
    """
    rng = np.random.default_rng(1)
    world = rng.uniform([-25, -6, -35], [25, GROUND_M, 45], (12_000, 3))
    seen = _seen_at(world, np.full(len(world), float(frame)))
    if turns_while_driving:
        for _ in range(4):  # when a point is faced depends on where the scanner is then
            azimuth = np.arctan2(seen[:, 1], seen[:, 0])
            seen = _seen_at(world, frame - 0.5 * azimuth / np.pi)
    return seen


def _seen_at(world: Array, frames: Array) -> Array:
    times, rows = np.unique(np.round(frames, 2), return_inverse=True)  # within a centimetre
    velo_from_world = np.linalg.inv(np.stack([true_pose(t) @ cam0_from_velo() for t in times]))
    turned = np.einsum("nij,nj->ni", velo_from_world[rows, :3, :3], world)
    return np.asarray(turned + velo_from_world[rows, :3, 3])


def surface_scan(frame: int) -> Array:
    """Return which of some fixed points on all surfaces the scanner sees, in its axes.

    Rings on a bare road tell a registration that nothing moved; these points tell all, and lie
    where the camera sees something.
    """
    world_from_velo = true_pose(frame) @ cam0_from_velo()
    ways = SURFACE - world_from_velo[:3, 3]
    far = np.linalg.norm(ways, axis=1)
    ways, far = ways[far < REACH_M], far[far < REACH_M]
    is_seen = np.abs(cast(world_from_velo[:3, 3], ways / far[:, None]) - far) < 1e-6
    return np.asarray(ways[is_seen] @ world_from_velo[:3, :3])


def _surface() -> Array:
    """Draw points evenly on the faces of the boxes and, fewer, on the road."""
    parts = []
    for low, high in zip(LOWS, HIGHS, strict=True):
        size = high - low
        for axis in range(3):
            area = size.prod() / size[axis]
            for end in (low, high):
                points = _RNG.uniform(low, high, (int(POINTS_PER_M2 * min(area, 60)), 3))
                points[:, axis] = end[axis]
                parts.append(points)
    road = _RNG.uniform([-12, GROUND_M, -30], [12, GROUND_M, 68], (6_000, 3))
    points = np.concatenate([*parts, road])
    return np.asarray(points[points[:, 1] <= GROUND_M])


POINTS_PER_M2 = 15
REACH_M = 40.0
SURFACE = _surface()


def view(frame: int) -> Array:
    """Return the (H, W, 3) image of the second camera: colours that go with the place."""
    world_from_cam = true_pose(frame) @ cam0_from_cam()
    directions = rays(INTRINSICS, *SIZE) @ world_from_cam[:3, :3].T
    depth = np.minimum(true_depth(frame), 500.0)
    points = world_from_cam[:3, 3] + directions * depth[..., None]
    waves = [np.sin(points @ np.array(w)) for w in ((3, 2, 1), (7, 5, -6), (1.1, 0.7, 0.9))]
    grey = 128 + 40 * sum(waves)
    colors = np.stack([grey, grey * 0.9, 255 - grey], axis=-1)
    return np.asarray(np.clip(colors, 0, 255), np.uint8)


def write_scan(path: Path, points: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = np.zeros((len(points), 4), "<f4")
    stored[:, :3] = points
    path.write_bytes(stored.tobytes())


def projection() -> Array:
    """Return the (3, 4) projection of the second camera from the axes of the first."""
    cam_from_cam0 = np.linalg.inv(cam0_from_cam())
    return np.asarray(INTRINSICS @ cam_from_cam0[:3])


def plain(frame: int) -> Array:
    """Return an image of one grey."""
    return np.full((*SIZE, 3), 20 * frame, np.uint8)


def write_kitti(
    root: Path,
    num: int = NUM,
    take: Callable[[int], Array] = landmarks,
    look: Callable[[int], Array] = plain,
) -> Path:
    """Write KITTI odometry's layout with scans."""
    folder = root / "sequences" / "00"
    for frame in range(num):
        write_png(folder / f"image_2/{frame:06d}.png", look(frame))
        write_scan(folder / f"velodyne/{frame:06d}.bin", take(frame))
    rows = {"P2": projection(), "Tr": cam0_from_velo()[:3]}
    (folder / "calib.txt").write_text("".join(map(_row, rows.items())))
    (folder / "times.txt").write_text("".join(f"{0.1 * frame:e}\n" for frame in range(num)))
    (root / "poses").mkdir()
    lines = [_numbers(true_pose(frame)[:3]) for frame in range(num)]
    (root / "poses/00.txt").write_text("\n".join(lines) + "\n")
    return root


def write_raw(drive: Path, num: int, take: Callable[[int], Array] = landmarks) -> Path:
    """Write KITTI's raw layout: the drive, and the calibration in the folder above."""
    for frame in range(num):
        image = np.full((*SIZE, 3), 20 * frame, np.uint8)
        write_png(drive / f"image_02/data/{frame:010d}.png", image)
        write_scan(drive / f"velodyne_points/data/{frame:010d}.bin", take(frame))
    stamps = [f"2011-09-26 13:02:{25 + 0.1 * frame:012.9f}\n" for frame in range(num)]
    (drive / "image_02/timestamps.txt").write_text("".join(stamps))
    half = np.eye(4)
    half[:3, :3] = rotation_exp(np.array([0.004, -0.002, 0.003]))
    unrectified_from_velo = np.linalg.inv(half) @ cam0_from_velo()
    size = np.array([SIZE[1], SIZE[0]])
    cameras = {"S_rect_02": size, "R_rect_00": half[:3, :3], "P_rect_02": projection()}
    scanner = {"R": unrectified_from_velo[:3, :3], "T": unrectified_from_velo[:3, 3]}
    for name, rows in (("cam_to_cam", cameras), ("velo_to_cam", scanner)):
        text = "calib_time: 09-Jan-2012 13:57:47\n" + "".join(map(_row, rows.items()))
        (drive.parent / f"calib_{name}.txt").write_text(text)
    return drive


def _row(row: tuple[str, Array]) -> str:
    return f"{row[0]}: {_numbers(row[1])}\n"


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.12e}" for value in np.ravel(values))
