"""VGGT: depth and camera of each frame, the first being the reference."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.feedforward import NetworkBackbone, View, inverted, window_camera
from laser_slam.config import BackboneConfig

if TYPE_CHECKING:
    from torch import Tensor

    from laser_slam.networks.vggt import Vggt, VggtOutput
    from laser_slam.networks.weights import Checkpoint

Array = NDArray[np.float64]


class VggtBackbone(NetworkBackbone):
    """VGGT (Wang et al., arXiv:2503.11651), by its depth and its cameras.

    Its unit is the window's own. Its point maps are not asked for: its authors found depth and
    cameras together more accurate. The principal point is where it puts it, half a pixel from the
    image's centre.
    """

    name = "vggt"

    def __init__(self, config: BackboneConfig, network: Vggt | None = None) -> None:
        super().__init__(config.vggt, network)

    def _checkpoint(self) -> Checkpoint:
        from laser_slam.networks.vggt import RELEASED  # noqa: PLC0415  (needs torch)

        return RELEASED

    def _load(self, weights: Path) -> Any:
        from laser_slam.networks.vggt import VggtConfig, load_vggt  # noqa: PLC0415

        shape = VggtConfig(chunk=self._config.chunk)
        return load_vggt(str(weights), self._placement.weights_dtype, shape)

    def _view(self, network: Any, images: Tensor, intrinsics: Array | None) -> View:
        known = intrinsics if self._config.intrinsics == "given" else None
        return view_of_depth(network(images), known)


def view_of_depth(output: VggtOutput, known: Array | None = None) -> View:
    """Read what VGGT says of one window.

    Confidence c, from 1 without limit, becomes 1 - 1/c: order is kept.

    Args:
        output: with B = 1.
        known: (3, 3) intrinsics in pixels, taken as they are; None: those of the network, one
            camera for all frames.
    """
    cam_from_world = output.cam_from_world[0].cpu().double().numpy()
    cameras = output.intrinsics[0].cpu().double().numpy()
    return View(
        output.depth[0].cpu().numpy(),
        (1 - 1 / output.depth_confidence[0]).cpu().numpy(),
        inverted(cam_from_world),
        window_camera(cameras) if known is None else known,
        output.tokens[0].cpu().numpy(),
    )
