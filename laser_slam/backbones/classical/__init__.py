"""Geometry on the CPU: tracks, bundle adjustment, plane sweep."""

from laser_slam.backbones.classical.backbone import ClassicalBackbone

__all__ = ["ClassicalBackbone"]
