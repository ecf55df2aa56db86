"""The metric path of a sequence by its laser scans, and runs judged by it."""

from laser_slam.lidar.comparison import compare_with_run, refuse_other_input
from laser_slam.lidar.reference import LidarDataset, LidarReference, make_reference
from laser_slam.lidar.summary import summarize_lidar
from laser_slam.lidar.tracking import track_camera

__all__ = [
    "LidarDataset",
    "LidarReference",
    "compare_with_run",
    "make_reference",
    "refuse_other_input",
    "summarize_lidar",
    "track_camera",
]
