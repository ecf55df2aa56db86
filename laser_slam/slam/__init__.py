"""The state machine: add windows one by one, know where every frame was."""

from laser_slam.slam.chain import Slam
from laser_slam.slam.loops import LoopCloser
from laser_slam.slam.node import Node
from laser_slam.slam.stored import StoredWindow, read_window

__all__ = ["LoopCloser", "Node", "Slam", "StoredWindow", "read_window"]
