"""Results in the formats that other programs read."""

from laser_slam.export.base import (
    Camera,
    DepthView,
    Photo,
    Photos,
    Points,
    Source,
    sample,
    survey,
)
from laser_slam.export.clouds import write_ply
from laser_slam.export.folders import check_replaceable
from laser_slam.export.formats import FORMATS, Format, find_writer
from laser_slam.export.trajectories import write_kitti, write_tum

__all__ = [
    "FORMATS",
    "Camera",
    "DepthView",
    "Format",
    "Photo",
    "Photos",
    "Points",
    "Source",
    "check_replaceable",
    "find_writer",
    "sample",
    "survey",
    "write_kitti",
    "write_ply",
    "write_tum",
]
