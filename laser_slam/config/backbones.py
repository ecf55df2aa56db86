"""The settings of the backbones."""

from __future__ import annotations

from pydantic import Field

from laser_slam.config.networks import DepthAnything3Config, NetworkConfig, Pi3XSettings
from laser_slam.config.section import Section
from laser_slam.config.simulated import SimulatedConfig


class ClassicalConfig(Section):
    """The default backbone: tracks, bundle adjustment, plane sweep; on the CPU."""

    max_width: int = Field(1280, ge=160, description="images wider than this are reduced, px")
    track_width: int = Field(640, ge=160, description="width at which corners are tracked, px")
    track_patch: int = Field(15, ge=5, le=31, description="side of the tracked patch, px")
    num_features: int = Field(1000, ge=100, description="corners per frame")
    max_backward_px: float = Field(0.7, gt=0, description="forward-backward gap of a good track")
    refine_radius: int = Field(
        5, ge=0, le=10, description="half side of aligned patches, px at 1280 wide; 0: none are"
    )
    context: int = Field(15, ge=0, description="earlier keyframes that steady a window's solution")
    depth_width: int = Field(640, ge=96, description="width of the depth maps, px")
    num_planes: int = Field(64, ge=16, le=256, description="inverse depths that are tried")


class ReplayConfig(Section):
    """Predictions that were made before, perhaps elsewhere."""

    folder: str = Field("", description="what 'laser-slam predict' wrote, or the folder of a run")
    made_by: str = Field("", description="the backbone that predicted; the run looks it up")


class BackboneConfig(Section):
    """The source of depth, poses and confidence."""

    name: str = Field("classical", description="one of the names in laser_slam.backbones.BACKBONES")
    classical: ClassicalConfig = ClassicalConfig()
    simulated: SimulatedConfig = SimulatedConfig()
    pi3: NetworkConfig = NetworkConfig()
    pi3x: Pi3XSettings = Pi3XSettings()
    vggt: NetworkConfig = NetworkConfig()
    depth_anything3: DepthAnything3Config = DepthAnything3Config()
    replay: ReplayConfig = ReplayConfig()

    @property
    def origin(self) -> str:
        """Return the name of the backbone that predicts, or did."""
        return self.replay.made_by if self.name == "replay" else self.name
