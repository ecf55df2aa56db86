"""Where a camera must stand to show a cloud well."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_from_fov, intrinsics_matrix, project
from laser_slam.report.splat import Viewpoint
from laser_slam.types import Cloud, Trajectory

Array = NDArray[np.float64]

_WIDTH_PX = 1200
_LOWEST_PX = 480
_SAMPLE = 200_000  # points that decide where a camera stands
_MARGIN = 0.04  # of the picture, left free around the map
_OUTLIERS = 0.2  # percent of the points, at each end of each axis, that need not be in the picture
_BIRD_TURN_DEG, _BIRD_DROP_DEG, _BIRD_FOV_DEG = 25.0, 38.0, 40.0
_DRIVER_FOV_DEG = 72.0
_CELL_PX = 40
_NEAR_PART = 3.0  # what lies nearer than so many median depths of the surface in view
_ONE_WAY = 0.6  # length of the mean viewing direction from which on cameras look one way
_DOWN_PRIOR = 0.003  # weight of the mean y axis against the x axes, squared sines
_DRIVER_BACK, _DRIVER_UP, _DRIVER_NEAR = 0.12, 0.04, 0.15  # of the median depth of the surface


def from_above(cloud: Cloud, trajectory: Trajectory) -> Viewpoint:
    """Look straight down, in parallel projection, so that the whole map fits.

    The first camera's forward points up in the picture, or to the right where the map is taller
    than wide, for a picture that fills the page.
    """
    down, forward = _down_and_forward(trajectory)
    world_from_cam = _looking(down, -forward)
    extent = _extent(cloud, trajectory, world_from_cam)
    if extent[1, 1] - extent[0, 1] > 1.2 * (extent[1, 0] - extent[0, 0]):
        world_from_cam = _looking(down, np.cross(down, forward))
        extent = _extent(cloud, trajectory, world_from_cam)
    low, high = extent
    span = np.maximum(high - low, 1e-9)
    border = 2 * _MARGIN * _WIDTH_PX
    scale = min((_WIDTH_PX - border) / span[0], (_WIDTH_PX - border) / span[1])
    height = max(round(scale * span[1] + border), _LOWEST_PX)
    middle = (low + high) / 2
    world_from_cam[:3, 3] = world_from_cam[:3, :3] @ [middle[0], middle[1], low[2] - span[2]]
    intrinsics = intrinsics_matrix(scale, scale, (_WIDTH_PX - 1) / 2, (height - 1) / 2)
    return Viewpoint(world_from_cam, intrinsics, (height, _WIDTH_PX), parallel=True)


def from_bird(cloud: Cloud, trajectory: Trajectory) -> Viewpoint:
    """Look down at a slant, from behind the start and aside, so that the whole map fits."""
    down, _ = _down_and_forward(trajectory)
    along = _main_direction(trajectory, cloud, down)
    turn, drop = np.radians(_BIRD_TURN_DEG), np.radians(_BIRD_DROP_DEG)
    aside = np.cross(down, along)
    level = np.cos(turn) * along + np.sin(turn) * aside
    look = np.cos(drop) * level + np.sin(drop) * down
    world_from_cam = _looking(look, down)
    size = (780, _WIDTH_PX)
    intrinsics = intrinsics_from_fov(_BIRD_FOV_DEG, *size)
    local = _local(cloud, trajectory, world_from_cam)
    world_from_cam[:3, 3] = world_from_cam[:3, :3] @ _fitting_center(local, intrinsics, size)
    return Viewpoint(world_from_cam, intrinsics, size)


def from_driver(cloud: Cloud, trajectory: Trajectory) -> Viewpoint:
    """Look along the camera, from a little behind and above, where the map fills the view most."""
    size = (600, _WIDTH_PX)
    intrinsics = intrinsics_from_fov(_DRIVER_FOV_DEG, *size)
    points = _sample(cloud)
    candidates = np.unique(np.linspace(0, len(trajectory.frames) - 1, 16).astype(int))
    seen = [_in_view(points, trajectory.world_from_cam[i], intrinsics, size) for i in candidates]
    best = int(np.argmax([value for _, value in seen]))
    world_from_cam = trajectory.world_from_cam[candidates[best]].copy()
    depth = seen[best][0]
    back, up = _DRIVER_BACK * depth, _DRIVER_UP * depth
    world_from_cam[:3, 3] -= back * world_from_cam[:3, 2] + up * world_from_cam[:3, 1]
    return Viewpoint(world_from_cam, intrinsics, size, near=back + _DRIVER_NEAR * depth)


def _looking(look: Array, down: Array) -> Array:
    """Return a (4, 4) camera at the origin that looks along ``look`` with ``down`` downwards."""
    z = look / np.linalg.norm(look)
    y = down - (down @ z) * z
    y /= np.linalg.norm(y)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    return world_from_cam


def _down_and_forward(trajectory: Trajectory) -> tuple[Array, Array]:
    """Return unit vectors: down, and level forward of the first camera.

    Cameras are seldom rolled but often pitched: down is square to their x axes, as far as these
    tell, else their mean y.
    """
    x_axes = trajectory.world_from_cam[:, :3, 0]
    mean_y = trajectory.world_from_cam[:, :3, 1].mean(axis=0)
    down = np.linalg.solve(x_axes.T @ x_axes / len(x_axes) + _DOWN_PRIOR * np.eye(3), mean_y)
    if np.linalg.norm(mean_y) < 0.1:  # upside down as often as upright
        down = trajectory.world_from_cam[0, :3, 1].copy()
    down /= np.linalg.norm(down)
    forward = trajectory.world_from_cam[0, :3, 2]
    level = forward - (forward @ down) * down
    if np.linalg.norm(level) < 0.1:  # the first camera looks down
        level = np.cross(trajectory.world_from_cam[0, :3, 0], down)
    return down, level / np.linalg.norm(level)


def _main_direction(trajectory: Trajectory, cloud: Cloud, down: Array) -> Array:
    """Return the level unit vector along which to look.

    Where most cameras looked one way, that way, because only these sides of things are known;
    else along the longest axis of the map.
    """
    _, forward = _down_and_forward(trajectory)
    mean_look = trajectory.world_from_cam[:, :3, 2].mean(axis=0)
    mean_look = mean_look - (mean_look @ down) * down
    if np.linalg.norm(mean_look) > _ONE_WAY:
        return np.asarray(mean_look / np.linalg.norm(mean_look))
    points = np.concatenate([_sample(cloud)[::10], trajectory.world_from_cam[:, :3, 3]])
    level = points - np.outer(points @ down, down)
    level -= level.mean(axis=0)
    _, vectors = np.linalg.eigh(level.T @ level + 1e-12 * np.eye(3) - np.outer(down, down) * 1e-9)
    along = vectors[:, -1] - (vectors[:, -1] @ down) * down
    if np.linalg.norm(along) < 0.1:
        return forward
    along /= np.linalg.norm(along)
    return along if along @ forward >= 0 else -along


def _sample(cloud: Cloud) -> Array:
    return cloud.points[:: max(1, len(cloud.points) // _SAMPLE)]


def _local(cloud: Cloud, trajectory: Trajectory, world_from_cam: Array) -> Array:
    """Return (N, 3) points of cloud and trajectory in camera axes, outliers clipped."""
    points, centers = _sample(cloud), trajectory.world_from_cam[:, :3, 3]
    local, path = points @ world_from_cam[:3, :3], centers @ world_from_cam[:3, :3]
    if len(local):
        low, high = np.percentile(local, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
        local = local[((local >= low) & (local <= high)).all(axis=1)]
    return np.concatenate([local, path])


def _extent(cloud: Cloud, trajectory: Trajectory, world_from_cam: Array) -> Array:
    """Return (2, 3): lower and upper corner in camera axes."""
    local = _local(cloud, trajectory, world_from_cam)
    return np.stack([local.min(axis=0), local.max(axis=0)])


def _fitting_center(local: Array, intrinsics: Array, size: tuple[int, int]) -> Array:
    """Return the camera centre, in camera axes, nearest to the points that still sees them all.

    For each side of the picture the camera must stay behind a plane; the two planes of an axis
    meet in the best place on it, and the axis that needs more distance decides.
    """
    center, behind = np.zeros(3), np.inf
    for axis, pixels in ((0, size[1]), (1, size[0])):
        slope = (1 - 2 * _MARGIN) * 0.5 * pixels / intrinsics[axis, axis]
        left = float((local[:, axis] + slope * local[:, 2]).min())
        right = float((local[:, axis] - slope * local[:, 2]).max())
        center[axis] = (left + right) / 2
        behind = min(behind, (left - right) / (2 * slope))
    center[2] = behind
    return center


def _in_view(
    points: Array, world_from_cam: Array, intrinsics: Array, size: tuple[int, int]
) -> tuple[float, int]:
    """Return the median depth of what is seen first, and how good the place is.

    A good place shows much of the map's near part (points) and little background (cells). Neither
    depends on how far the map goes on behind.
    """
    local = (points - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
    pixels = project(local, intrinsics)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < (size[1], size[0]))).all(axis=1)
    if not inside.any():
        return 1.0, 0
    order = np.argsort(local[inside, 2])
    depths = local[inside, 2][order]
    cells = (pixels[inside][order] // _CELL_PX).astype(np.int64)
    _, nearest = np.unique(cells[:, 0] + cells[:, 1] * size[1], return_index=True)
    depth = float(np.median(depths[nearest]))
    return depth, len(nearest) * int((depths < _NEAR_PART * depth).sum())
