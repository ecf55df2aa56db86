"""The settings of the viewer."""

from __future__ import annotations

from pydantic import Field

from laser_slam.config.section import Section


class ViewerConfig(Section):
    """How much the viewer shows; what the map leaves out (``fusion``), it leaves out too."""

    points_per_window: int = Field(20_000, ge=1, description="points shown of a window")
    max_points: int = Field(
        3_000_000, ge=1, description="points shown of all windows; beyond, every second one goes"
    )
    points_per_frame: int = Field(
        0, ge=0, description="points of a cloud for each frame, shown at its time only; 0: none"
    )
    image_width: int = Field(
        320, ge=0, le=4096, description="width of images, depth, confidence, layers; 0: none; px"
    )
    jpeg_quality: int = Field(75, ge=1, le=100, description="of images and confidence")
    move_tolerance: float = Field(
        0.01, ge=0, description="least motion of a window that is shown, in its median depths"
    )
