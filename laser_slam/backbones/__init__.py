"""Backbones: images of one window to depth, confidence, poses and intrinsics."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from laser_slam.dependencies import import_named

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from laser_slam.backbones.base import Backbone
    from laser_slam.config import BackboneConfig
    from laser_slam.types import SequenceInfo

BACKBONES = {
    "classical": "laser_slam.backbones.classical:ClassicalBackbone",
    "simulated": "laser_slam.backbones.simulated:SimulatedBackbone",
    "pi3": "laser_slam.backbones.pi3:Pi3Backbone",
    "pi3x": "laser_slam.backbones.pi3x:Pi3XBackbone",
    "vggt": "laser_slam.backbones.vggt:VggtBackbone",
    "depth_anything3": "laser_slam.backbones.depth_anything3:DepthAnything3Backbone",
}
NETWORKS = {"pi3", "pi3x", "vggt"}  # whose memory is known
REPLAY = "replay"  # in the settings: no backbone, but what one has predicted before
WINDOW_SIZE = 20  # keyframes, where memory is no limit
ON_CPU = {"classical", "simulated"}
FROM_TRUTH = {"simulated"}  # these are made from what the data set knows, too


def make_backbone(
    config: BackboneConfig,
    info: SequenceInfo | None = None,
    true_depth: Callable[[int], NDArray[np.float32] | None] | None = None,
) -> Backbone:
    """Import and build the backbone that the settings name.

    Args:
        config: its name and settings.
        info: of the data set, for a backbone that simulates; None: there is none.
        true_depth: (H, W) metres of a frame of the data set, NaN: unknown; None: there is none.

    Raises:
        ConfigError: no backbone has this name, or it simulates and the data set has no truth.
    """
    chosen = import_named(BACKBONES, config.name, "backbone.name", [REPLAY])
    truth = (info, true_depth) if config.name in FROM_TRUTH else ()
    backbone: Backbone = chosen(config, *truth)
    return backbone


def choose_window_size(config: BackboneConfig, size: tuple[int, int], overlap: int) -> int:
    """Choose how many keyframes a window has.

    Args:
        config: of the backbone.
        size: (height, width) of the data set's images.
        overlap: keyframes that neighbouring windows share.

    Raises:
        ConfigError: the network's device is not there.
        DependencyError: PyTorch is not installed.
    """
    if config.name not in NETWORKS:
        return max(overlap + 3, WINDOW_SIZE)
    from laser_slam.backbones.feedforward import fitting_window  # noqa: PLC0415

    return fitting_window(config.name, getattr(config, config.name), size, overlap)


def is_on_cpu(config: BackboneConfig) -> bool:
    """Tell whether the backbone has no use for a GPU."""
    section = getattr(config, config.name, None)
    return config.name in ON_CPU or getattr(section, "device", "").startswith("cpu")
