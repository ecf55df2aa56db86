"""Metrics: numbers in, numbers out; no files, no plots."""

from laser_slam.evaluation.depth import DepthErrors, evaluate_depth
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

__all__ = [
    "DepthErrors",
    "KittiErrors",
    "Statistics",
    "TrajectoryErrors",
    "absolute_errors",
    "align",
    "evaluate_depth",
    "evaluate_trajectory",
    "kitti_errors",
    "relative_errors",
]
