"""The state machine: add windows one by one, know where every frame was."""

from laser_slam.slam.chain import Slam
from laser_slam.slam.node import Node

__all__ = ["Node", "Slam"]
