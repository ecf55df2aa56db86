"""The settings of exports."""

from __future__ import annotations

from pydantic import Field

from laser_slam.config.section import Section


class ExportConfig(Section):
    """Files for other programs."""

    max_points: int = Field(
        500_000, ge=1, description="points that Gaussian splatting starts from (COLMAP, nerfstudio)"
    )
    mesh_voxel: float = Field(
        2.0, gt=0, description="edge of the mesh's voxels, in voxels of the map"
    )
    mesh_truncation: float = Field(
        12.0,
        ge=2,
        description="depth of the band around surfaces in which depth maps are averaged, in the "
        "mesh's voxels; less leaves holes in what is seen at a grazing angle",
    )
    mesh_min_views: float = Field(
        3.0, ge=0, description="frames that must have seen a piece of the mesh"
    )
    mesh_tile: int = Field(
        512, ge=16, description="edge of the tiles that the mesh is made in, in its voxels"
    )
