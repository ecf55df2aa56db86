"""Backbones: images of one window to depth, confidence, poses and intrinsics."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from laser_slam.errors import ConfigError

if TYPE_CHECKING:
    from laser_slam.backbones.base import Backbone
    from laser_slam.config import BackboneConfig

BACKBONES = {"classical": "laser_slam.backbones.classical:ClassicalBackbone"}


def make_backbone(config: BackboneConfig) -> Backbone:
    """Import and build the backbone that the settings name.

    Raises:
        ConfigError: no backbone has this name.
    """
    if config.name not in BACKBONES:
        raise ConfigError(f"backbone.name: no '{config.name}'; there is {', '.join(BACKBONES)}")
    module, _, attribute = BACKBONES[config.name].partition(":")
    backbone: Backbone = getattr(import_module(module), attribute)(config)
    return backbone
