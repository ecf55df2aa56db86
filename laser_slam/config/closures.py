"""The settings of closures: how a candidate is measured, and what it must pass."""

from __future__ import annotations

from pydantic import Field

from laser_slam.config.section import Section


class ClosuresConfig(Section):
    """Candidates measured and judged."""

    enabled: bool = Field(True, description="look for places seen before and close the loops")
    neighbours: int = Field(
        2, ge=0, description="frames on each side of the matched one that are matched as well"
    )
    neighbour_step: int = Field(2, ge=1, description="frames from one of these to the next")
    max_error_px: float = Field(
        8.0, gt=0, description="reprojection error of an inlier, in both images, px at 640 wide"
    )
    max_depth_ratio: float = Field(
        1.35, gt=1, description="disagreement of an inlier's depths, either way"
    )
    min_inliers: int = Field(30, ge=8, description="matches with depth that fit one similarity")
    min_inlier_share: float = Field(
        0.4, ge=0, le=1, description="of the matches with depth, those that must fit it"
    )
    loop_frames: int = Field(
        10, ge=2, description="frames of each end in the window of both ends; see backbones"
    )
    max_residual: float = Field(
        0.15, gt=0, description="median disagreement of depths that were aligned, log"
    )
    max_disagreement: float = Field(
        6.0, gt=0, description="between two measurements of one closure, in sigmas"
    )
    max_scale_ratio: float = Field(
        2.0, gt=1, description="scale against what the chain says, either way, of near windows"
    )
    scale_drift: float = Field(
        0.05, ge=0, description="drift of the chain's scale from window to window, log, sigma"
    )
    max_heading_deg: float = Field(
        60.0, gt=0, le=180, description="angle between the optical axes of the matched frames"
    )
    cloud_frames: int = Field(
        2, ge=0, description="frames on each side of the matched one that give points"
    )
    voxel: float = Field(0.02, gt=0, description="edge of the clouds' voxels, in median depths")
    max_range: float = Field(3.0, gt=0, description="farther points stay out, in median depths")
    max_distance: float = Field(
        0.05, gt=0, description="between surfaces that are one, in median depths, or in their depth"
    )
    min_covisible: float = Field(
        0.1, ge=0, le=1, description="share of the points that both ends could see"
    )
    min_overlap: float = Field(
        0.7, ge=0, le=1, description="of these, the share that the other end has a surface at"
    )
    max_move: float = Field(
        0.1, gt=0, description="of the cloud by its registration, rms, in median depths"
    )
    max_turn_deg: float = Field(3.0, gt=0, description="of the cloud by its registration")
