"""A stand-in for feed-forward networks: the truth of a data set, distorted as they distort it."""

from laser_slam.backbones.simulated.backbone import SimulatedBackbone

__all__ = ["SimulatedBackbone"]
