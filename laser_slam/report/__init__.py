"""The pictures of a run, drawn without a display."""

from laser_slam.report.clouds import CloudView, cloud_picture
from laser_slam.report.curves import drift_picture, stages_picture, trajectory_picture
from laser_slam.report.depths import depth_picture
from laser_slam.report.layers import layers_picture, mismatch_picture
from laser_slam.report.splat import Viewpoint, render_points

__all__ = [
    "CloudView",
    "Viewpoint",
    "cloud_picture",
    "depth_picture",
    "drift_picture",
    "layers_picture",
    "mismatch_picture",
    "render_points",
    "stages_picture",
    "trajectory_picture",
]
