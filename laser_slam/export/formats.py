"""All formats, by the name that --to takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from laser_slam.dependencies import import_named
from laser_slam.export.base import Source
from laser_slam.export.checks import (
    can_be_las,
    has_graph,
    has_keyframes,
    has_photos,
    has_points,
    has_surface,
)

Writer = Callable[[Path, Source], None]
Check = Callable[[Source], None]


@dataclass(frozen=True)
class Format:
    """A format that runs can be exported to.

    Attributes:
        writer: ``module:function`` that takes a path and a source.
        target: name of the file or folder that comes out.
        check: function of ``checks`` that refuses a source which this cannot be made of; None:
            every finished run will do.
        is_folder: more than one file comes out.
        is_cloud: it holds the points of the map and little else, and can be geo-referenced.
    """

    writer: str
    target: str
    check: Check | None = None
    is_folder: bool = False
    is_cloud: bool = False


_HERE = "laser_slam.export"

FORMATS = {
    "ply": Format(f"{_HERE}.clouds:export_ply", "map.ply", has_points, is_cloud=True),
    "pcd": Format(f"{_HERE}.clouds:export_pcd", "map.pcd", has_points, is_cloud=True),
    "xyz": Format(f"{_HERE}.clouds:export_xyz", "map.xyz", has_points, is_cloud=True),
    "xyz.gz": Format(f"{_HERE}.clouds:export_xyz_gz", "map.xyz.gz", has_points, is_cloud=True),
    "las": Format(f"{_HERE}.las:export_las", "map.las", can_be_las, is_cloud=True),
    "laz": Format(f"{_HERE}.las:export_laz", "map.laz", can_be_las, is_cloud=True),
    "mesh-ply": Format(f"{_HERE}.mesh:export_mesh_ply", "mesh.ply", has_surface),
    "mesh-glb": Format(f"{_HERE}.mesh:export_mesh_glb", "mesh.glb", has_surface),
    "kitti": Format(f"{_HERE}.trajectories:export_kitti", "trajectory_kitti.txt"),
    "tum": Format(f"{_HERE}.trajectories:export_tum", "trajectory_tum.txt"),
    "euroc": Format(f"{_HERE}.trajectories:export_euroc", "trajectory_euroc.csv"),
    "g2o": Format(f"{_HERE}.trajectories:export_g2o", "graph.g2o", has_graph),
    "colmap": Format(f"{_HERE}.colmap:export_colmap", "colmap", has_photos, is_folder=True),
    "colmap-text": Format(
        f"{_HERE}.colmap:export_colmap_text", "colmap-text", has_photos, is_folder=True
    ),
    "nerfstudio": Format(
        f"{_HERE}.nerfstudio:export_nerfstudio", "nerfstudio", has_photos, is_folder=True
    ),
    "depth": Format(f"{_HERE}.depth:export_depth", "depth", has_keyframes, is_folder=True),
    "depth-npz": Format(
        f"{_HERE}.depth:export_depth_npz", "depth-npz", has_keyframes, is_folder=True
    ),
}


def find_writer(name: str) -> Writer:
    """Import the function that writes a format.

    Raises:
        ConfigError: there is no such format.
    """
    writers = {key: item.writer for key, item in FORMATS.items()}
    writer: Writer = import_named(writers, name, "--to")
    return writer
