"""The pictures of a run, drawn without a display."""

from laser_slam.report.clouds import CloudView, cloud_picture
from laser_slam.report.curves import drift_picture, stages_picture, trajectory_picture
from laser_slam.report.depths import depth_picture
from laser_slam.report.layers import layers_picture, mismatch_picture
from laser_slam.report.loops import (
    LoopPaths,
    ScaleCurves,
    frame_pairs,
    loops_picture,
    scales_picture,
)
from laser_slam.report.pairs import ImagePair, pairs_picture, similarity_picture
from laser_slam.report.splat import Viewpoint, render_points

__all__ = [
    "CloudView",
    "ImagePair",
    "LoopPaths",
    "ScaleCurves",
    "Viewpoint",
    "cloud_picture",
    "depth_picture",
    "drift_picture",
    "frame_pairs",
    "layers_picture",
    "loops_picture",
    "mismatch_picture",
    "pairs_picture",
    "render_points",
    "scales_picture",
    "similarity_picture",
    "stages_picture",
    "trajectory_picture",
]
