"""How many frames a network takes at once."""

from __future__ import annotations

import logging

from laser_slam.backbones.feedforward.sizes import network_size
from laser_slam.config.networks import NetworkConfig
from laser_slam.dependencies import import_torch

# LASER's authors drive with 75. Attention across frames grows with the square: at 518x154 it takes
# as long as all else from 60 frames on, and the networks were trained on fewer.
MOST_FRAMES = 75
LEAST_NEW = 3  # frames that a window adds to the one before it
logger = logging.getLogger(__name__)


def fitting_window(name: str, config: NetworkConfig, size: tuple[int, int], overlap: int) -> int:
    """Return how many frames fit in the device's free memory, within what is good for anything.

    Args:
        name: of the network.
        config: of the network, which is not loaded yet.
        size: (height, width) of the data set's images.
        overlap: frames that neighbouring windows share.

    Raises:
        ConfigError: the device is not there.
        DependencyError: PyTorch is not installed.
    """
    import_torch()
    from laser_slam.networks.memory import Request  # noqa: PLC0415  (networks are for use only)
    from laser_slam.networks.placement import choose_placement  # noqa: PLC0415

    placement = choose_placement(config.device, config.dtype, f"backbone.{name}")
    wanted = network_size(size, config.size_rule, config.size_limit)
    request = Request(name, wanted, placement.dtype_name, config.chunk)
    fits, least = request.largest_window(placement.free_bytes()), overlap + LEAST_NEW
    if fits < least:
        logger.warning(
            "%s has memory for windows of %d frames, but an overlap of %d needs %d: "
            "lower windows.overlap or backbone.%s.side",
            placement.device,
            fits,
            overlap,
            least,
            name,
        )
    return max(least, min(fits, MOST_FRAMES))
