"""From a run's world to metres, by the path of the same cameras that laser scans give."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation.trajectory import common_frames, path_distances
from laser_slam.sim3 import Sim3, umeyama
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

MIN_PATH_M = 1.0  # a shorter path has no scale
STRETCH_M = 1.0  # the least length over which a scale is measured
MOST_STRETCHES = 20
PIECE_M = 50.0  # of the path, over which a drift is no matter
MOST_DRIFT = 4.0  # of the scale of a piece from that of the whole: beyond, the run was lost there


def align_cameras(estimate: Trajectory, lidar: Trajectory) -> Sim3:
    """Find the similarity between two paths by the places and the headings of their cameras.

    The places alone leave a straight path free to roll. Each camera stands for its centre and
    the ends of its axes, as long as the path is wide.

    Args:
        estimate: in world units.
        lidar: in metres, of some of its frames.

    Returns:
        ``lidar_from_world``; its scale is metres per world unit.

    Raises:
        DegenerateGeometryError: fewer than 2 common frames, or one of the paths is a point.
    """
    estimate, lidar = common_frames(estimate, lidar)
    if len(lidar.frames) < 2:
        raise DegenerateGeometryError(
            f"run and scans have {len(lidar.frames)} frames in common, need 2"
        )
    path_m = float(path_distances(lidar)[-1])
    if path_m < MIN_PATH_M:
        raise DegenerateGeometryError(
            f"the scanner moved {path_m:.2f} m, need {MIN_PATH_M:g} m to measure a scale"
        )
    return umeyama(_anchors(estimate.world_from_cam), _anchors(lidar.world_from_cam))


def _anchors(world_from_cam: Array) -> Array:
    """Return (7 N, 3) points that stand for N cameras."""
    centers = world_from_cam[:, :3, 3]
    length = np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean())
    if length <= 1e-9 * max(float(np.abs(centers).max()), 1e-300):
        raise DegenerateGeometryError("the run's path stays in one place: it has no scale")
    axes = length * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = centers[:, None] + axes @ np.swapaxes(world_from_cam[:, :3, :3], 1, 2)
    return np.asarray(points.reshape(-1, 3))


@dataclass(frozen=True)
class Pieces:
    """A path in pieces that are aligned each for itself, so that no drift is between them.

    Attributes:
        whole: ``lidar_from_world`` of the path in one piece.
        starts: (K,) first frame of each piece but the first.
        lidar_from_world: K + 1 similarities.
        frames: (N,) of the cameras that both paths have.
        centers: (N, 3) of these cameras in the run's world.
    """

    whole: Sim3
    starts: NDArray[np.int64]
    lidar_from_world: tuple[Sim3, ...]
    frames: NDArray[np.int64]
    centers: Array

    def at(self, frame: int) -> Sim3:
        """Return ``lidar_from_world`` of the piece that a frame belongs to."""
        return self.lidar_from_world[int(np.searchsorted(self.starts, frame, side="right"))]

    def apply(self, points: Array) -> Array:
        """Map (N, 3) points of the world, each with the piece whose cameras are nearest."""
        _, nearest = cKDTree(self.centers).query(points)
        pieces = np.searchsorted(self.starts, self.frames[nearest], side="right")
        out = np.empty_like(points)
        for piece in np.unique(pieces):
            chosen = pieces == piece
            out[chosen] = self.lidar_from_world[piece].apply(points[chosen])
        return out


def align_pieces(estimate: Trajectory, lidar: Trajectory) -> Pieces:
    """Align a path with that of the scans piece by piece, each about ``PIECE_M`` long.

    A piece in which the run does not move, or hardly, goes with the whole path.

    Args:
        estimate: in world units.
        lidar: in metres, of some of its frames.

    Raises:
        DegenerateGeometryError: fewer than 2 common frames, or one of the paths is a point.
    """
    whole = align_cameras(estimate, lidar)
    estimate, lidar = common_frames(estimate, lidar)
    distances = path_distances(lidar)
    num = max(1, round(distances[-1] / PIECE_M))
    ends = _even_rows(distances, num)
    parts = []
    for first, last in pairwise(ends):
        rows = slice(first, last + 1)  # neighbours share a camera
        parts.append(_align_piece(_cut(estimate, rows), _cut(lidar, rows), whole))
    centers = np.array(estimate.world_from_cam[:, :3, 3])
    return Pieces(whole, lidar.frames[ends[1:-1]], tuple(parts), lidar.frames, centers)


def _align_piece(estimate: Trajectory, lidar: Trajectory, whole: Sim3) -> Sim3:
    try:
        piece = align_cameras(estimate, lidar)
    except DegenerateGeometryError:
        return whole
    return piece if 1 / MOST_DRIFT < piece.scale / whole.scale < MOST_DRIFT else whole


def stretch_scales(estimate: Trajectory, lidar: Trajectory) -> Array:
    """Return (K,) metres per world unit of up to ``MOST_STRETCHES`` even stretches of the path."""
    estimate, lidar = common_frames(estimate, lidar)
    distances = path_distances(lidar)
    ends = _even_rows(distances, int(np.clip(distances[-1] / STRETCH_M, 1, MOST_STRETCHES)))
    moved, true = (
        np.linalg.norm(np.diff(path.world_from_cam[ends, :3, 3], axis=0), axis=1)
        for path in (estimate, lidar)
    )
    return np.asarray(true[moved > 0] / moved[moved > 0])


def _even_rows(distances: Array, num: int) -> NDArray[np.intp]:
    """Return the rows at the ends of up to ``num`` stretches of about the same length."""
    return np.unique(np.searchsorted(distances, np.linspace(0, distances[-1], num + 1)))


def _cut(path: Trajectory, rows: slice) -> Trajectory:
    return Trajectory(path.frames[rows], path.times_s[rows], path.world_from_cam[rows])
