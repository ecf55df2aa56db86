"""The settings of the map."""

from __future__ import annotations

from pydantic import Field

from laser_slam.config.section import Section


class FusionConfig(Section):
    """Submaps to one coloured cloud."""

    min_confidence: float = Field(0.5, ge=0, le=1, description="pixels below it stay out")
    max_range: float = Field(
        3.0, gt=0, description="depth beyond which pixels stay out, in median depths of the window"
    )
    edge_jump: float = Field(
        0.05, gt=0, description="depth step between neighbours that makes an edge, in its depth"
    )
    agreement: float = Field(
        0.03,
        ge=0,
        description="relative depth difference within which frames agree on a pixel; 0: not asked",
    )
    min_agreeing: int = Field(
        1, ge=0, le=6, description="frames around that must agree with a pixel"
    )
    stride: int = Field(1, ge=1, description="every so many-th row and column is used")
    voxel_size: float = Field(
        0.0, ge=0, description="edge of the averaging voxels in world units; 0: auto_voxel decides"
    )
    auto_voxel: float = Field(
        0.006,
        gt=0,
        description="edge of the voxels, in median depths of the first good window; no less than "
        "the gap between used pixels there",
    )
    min_observations: int = Field(
        20, ge=1, description="views that a voxel and its 26 neighbours need in sum; fewer: noise"
    )
    tile_bits: int = Field(
        8, ge=3, le=12, description="the map is made in cubes of 2^tile_bits voxels"
    )
    active_voxels: int = Field(
        1_000_000,
        ge=1,
        description="voxels in memory beyond which cubes go to disk (90 bytes each)",
    )
    cloud_points: int = Field(
        10_000_000, ge=1, description="points that pictures and Python users get at most"
    )
