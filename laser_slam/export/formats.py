"""All formats, by the name that --to takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from laser_slam.dependencies import import_named
from laser_slam.export.base import Source

Writer = Callable[[Path, Source], None]


@dataclass(frozen=True)
class Format:
    """A format that runs can be exported to.

    Attributes:
        writer: ``module:function`` that takes a path and a source.
        target: name of the file or folder that comes out.
        needs: ``module:function`` that raises where an extra is missing; None: it needs none.
        is_folder: more than one file comes out.
        is_cloud: it holds the points of the map and little else, and can be geo-referenced.
    """

    writer: str
    target: str
    needs: str | None = None
    is_folder: bool = False
    is_cloud: bool = False


_HERE = "laser_slam.export"
_LAS = "laser_slam.dependencies:import_laspy"

FORMATS = {
    "ply": Format(f"{_HERE}.clouds:export_ply", "map.ply", is_cloud=True),
    "pcd": Format(f"{_HERE}.clouds:export_pcd", "map.pcd", is_cloud=True),
    "xyz": Format(f"{_HERE}.clouds:export_xyz", "map.xyz", is_cloud=True),
    "xyz.gz": Format(f"{_HERE}.clouds:export_xyz_gz", "map.xyz.gz", is_cloud=True),
    "las": Format(f"{_HERE}.las:export_las", "map.las", _LAS, is_cloud=True),
    "laz": Format(f"{_HERE}.las:export_laz", "map.laz", _LAS, is_cloud=True),
    "mesh-ply": Format(f"{_HERE}.mesh:export_mesh_ply", "mesh.ply"),
    "mesh-glb": Format(f"{_HERE}.mesh:export_mesh_glb", "mesh.glb"),
    "kitti": Format(f"{_HERE}.trajectories:export_kitti", "trajectory_kitti.txt"),
    "tum": Format(f"{_HERE}.trajectories:export_tum", "trajectory_tum.txt"),
    "euroc": Format(f"{_HERE}.trajectories:export_euroc", "trajectory_euroc.csv"),
    "g2o": Format(f"{_HERE}.trajectories:export_g2o", "graph.g2o"),
    "colmap": Format(f"{_HERE}.colmap:export_colmap", "colmap", is_folder=True),
    "colmap-text": Format(f"{_HERE}.colmap:export_colmap_text", "colmap-text", is_folder=True),
    "nerfstudio": Format(f"{_HERE}.nerfstudio:export_nerfstudio", "nerfstudio", is_folder=True),
    "depth": Format(f"{_HERE}.depth:export_depth", "depth", is_folder=True),
    "depth-npz": Format(f"{_HERE}.depth:export_depth_npz", "depth-npz", is_folder=True),
}


def find_writer(name: str) -> Writer:
    """Import the function that writes a format.

    Raises:
        ConfigError: there is no such format.
        DependencyError: an extra that it needs is not installed.
    """
    writers = {key: item.writer for key, item in FORMATS.items()}
    writer: Writer = import_named(writers, name, "--to")
    needs = FORMATS[name].needs
    if needs is not None:
        import_named({name: needs}, name, "--to")()
    return writer
