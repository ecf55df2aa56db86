"""Sim(3) pose graph of the windows, in GTSAM; no other stage imports it."""

from laser_slam.pose_graph.g2o import read_g2o, write_g2o
from laser_slam.pose_graph.graph import Link, Optimised, PoseGraph
from laser_slam.pose_graph.spread import MovedWindow, spread_corrections, spread_poses

__all__ = [
    "Link",
    "MovedWindow",
    "Optimised",
    "PoseGraph",
    "read_g2o",
    "spread_corrections",
    "spread_poses",
    "write_g2o",
]
