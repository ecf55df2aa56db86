"""Metrics: numbers in, numbers out; no files, no plots."""

from laser_slam.evaluation.depth import DepthErrors, evaluate_depth
from laser_slam.evaluation.points import (
    INDOOR_POINTS,
    OUTDOOR_POINTS,
    PointErrors,
    PointMap,
    PointProtocol,
    comparable_depth,
    evaluate_points,
)
from laser_slam.evaluation.trajectory import (
    KittiErrors,
    Statistics,
    TrajectoryErrors,
    absolute_errors,
    align,
    evaluate_trajectory,
    kitti_errors,
    relative_errors,
)
from laser_slam.evaluation.video_depth import (
    VIDEO_DEPTH_PROTOCOLS,
    VideoDepthErrors,
    VideoDepthProtocol,
    evaluate_video_depth,
    resize_depth,
)

__all__ = [
    "INDOOR_POINTS",
    "OUTDOOR_POINTS",
    "VIDEO_DEPTH_PROTOCOLS",
    "DepthErrors",
    "KittiErrors",
    "PointErrors",
    "PointMap",
    "PointProtocol",
    "Statistics",
    "TrajectoryErrors",
    "VideoDepthErrors",
    "VideoDepthProtocol",
    "absolute_errors",
    "align",
    "comparable_depth",
    "evaluate_depth",
    "evaluate_points",
    "evaluate_trajectory",
    "evaluate_video_depth",
    "kitti_errors",
    "relative_errors",
    "resize_depth",
]
