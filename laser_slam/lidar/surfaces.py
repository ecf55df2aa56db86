"""A run's map against laser scans: distances, a cloud coloured by them, and the scans' own."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.bookkeeping import Progress
from laser_slam.datasets.velodyne import Velodyne
from laser_slam.dependencies import num_threads
from laser_slam.evaluation.clouds import REACH_M, ScanDistances, cloud_errors
from laser_slam.evaluation.trajectory import path_distances
from laser_slam.export import write_ply
from laser_slam.lidar.alignment import Pieces
from laser_slam.report import CloudView, cloud_picture
from laser_slam.sim3 import Sim3
from laser_slam.types import Cloud, Trajectory

Array = NDArray[np.float64]

MOST_POINTS = 300_000  # of the map, evenly taken
MOST_LASER_POINTS = 1_000_000  # of the file of scans
SCANS_APART_M = 0.5  # scans from nearer together say the same of the map
MOST_SCANS = 2000
MAP_PLY, SCANS_PLY, PICTURE = "map_to_scans.ply", "scans.ply", "map_to_scans.png"
LIMITS_M = (0.1, 0.2, 0.5)
COLORS = np.array(  # within each limit, beyond all, not compared
    [[26, 150, 65], [166, 217, 106], [253, 174, 97], [215, 25, 28], [170, 170, 170]], np.uint8
)
SCAN_COLOR = (60, 90, 160)


def compare_surfaces(
    cloud: Cloud,
    lidar_from_world: Sim3,
    pieces: Pieces,
    scans: tuple[Velodyne, Trajectory],
    folder: Path,
    watch: Progress,
) -> dict[str, Any]:
    """Measure how far a map is from scans, with and without the drift of its path.

    Args:
        cloud: the map, or an even part of it, in world units.
        lidar_from_world: by the whole path.
        pieces: by its pieces.
        scans: the scans, and the camera's path by them in metres.
        folder: gets the points coloured by their distance, a picture of them, and the scans.
        watch: called as it goes on.

    Raises:
        DatasetError: a scan is broken.
        RunFolderError: a file cannot be written.
    """
    velodyne, lidar = scans
    whole, by_pieces = lidar_from_world.apply(cloud.points), pieces.apply(cloud.points)
    chosen = _spaced(lidar)
    world_from_scanner = lidar.world_from_cam[chosen] @ velodyne.rig.cam_from_velo
    distances = ScanDistances(np.concatenate([whole, by_pieces]), world_from_scanner)
    laser = []
    for index, frame in enumerate(lidar.frames[chosen]):
        scan = velodyne.points(int(frame))
        distances.add(index, scan, num_threads())
        laser.append(_thinned(scan, world_from_scanner[index], MOST_LASER_POINTS // len(chosen)))
        watch("comparing the map", index + 1, len(chosen))
    drifted, still = np.split(distances.distances, 2)
    voxel_size = cloud.voxel_size * lidar_from_world.scale
    colored = Cloud(by_pieces, _colors(still), cloud.weights, voxel_size)
    write_ply(folder / MAP_PLY, colored)
    write_ply(folder / SCANS_PLY, _plain(np.concatenate(laser)))
    cloud_picture(folder / PICTURE, colored, lidar, CloudView.ABOVE, unit="m")
    return {
        **asdict(cloud_errors(drifted)),
        "by_pieces": asdict(cloud_errors(still)) | {"num_pieces": len(pieces.lidar_from_world)},
        "num_scans": len(chosen),
        "voxel_size_m": voxel_size,
    }


def _spaced(lidar: Trajectory) -> list[int]:
    """Choose rows of scans that are not all taken from the same place."""
    distances = path_distances(lidar)
    apart_m = max(SCANS_APART_M, float(distances[-1]) / MOST_SCANS)
    rows: list[int] = []
    last_m = -np.inf
    for row, at_m in enumerate(distances):
        if at_m - last_m >= apart_m:
            rows.append(row)
            last_m = at_m
    return rows


def _thinned(scan: Array, world_from_scanner: Array, most: int) -> NDArray[np.float32]:
    near = scan[np.linalg.norm(scan, axis=1) < REACH_M]
    near = near[:: max(1, -(-len(near) // max(most, 1)))]
    placed = near @ world_from_scanner[:3, :3].T + world_from_scanner[:3, 3]
    return np.asarray(placed, np.float32)


def _plain(points: NDArray[np.float32]) -> Cloud:
    colors = np.tile(np.array(SCAN_COLOR, np.uint8), (len(points), 1))
    return Cloud(points.astype(np.float64), colors, np.ones(len(points), np.float32))


def _colors(distances: Array) -> NDArray[np.uint8]:
    kinds = np.searchsorted(LIMITS_M, distances)
    return COLORS[np.where(np.isnan(distances), len(COLORS) - 1, kinds)]
