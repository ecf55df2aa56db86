"""Submaps to one coloured cloud: a voxel-hashed average in tiles, in bounded memory."""

from laser_slam.fusion.memory import fuse
from laser_slam.fusion.tiled import Part, TiledMap, Update, Watch

__all__ = ["Part", "TiledMap", "Update", "Watch", "fuse"]
