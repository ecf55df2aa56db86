"""pi3x: as pi3, in approximate metres, and told of the camera where it is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.feedforward import NetworkBackbone, View
from laser_slam.backbones.pi3 import view_of_points
from laser_slam.config import BackboneConfig

if TYPE_CHECKING:
    from torch import Tensor

    from laser_slam.networks.pi3x import Pi3X
    from laser_slam.networks.weights import Checkpoint

Array = NDArray[np.float64]


class Pi3XBackbone(NetworkBackbone):
    """pi3x, the successor of pi3: its unit is about a metre.

    Known intrinsics are a prior of the network. Its points then lie on rays about the given
    principal point; else about the image's centre. Focal lengths are fitted either way.
    """

    name = "pi3x"

    def __init__(self, config: BackboneConfig, network: Pi3X | None = None) -> None:
        super().__init__(config.pi3x, network)
        self._is_told = config.pi3x.told_intrinsics

    def identity(self) -> dict[str, Any]:
        """Return network, checkpoint and settings; see `laser_slam.backbones.base.Backbone`."""
        return {**super().identity(), "told_intrinsics": self._is_told}

    def _checkpoint(self) -> Checkpoint:
        from laser_slam.networks.pi3x import RELEASED  # noqa: PLC0415  (needs torch)

        return RELEASED

    def _load(self, weights: Path) -> Any:
        from laser_slam.networks.pi3x import Pi3XConfig, load_pi3x  # noqa: PLC0415

        shape = Pi3XConfig(takes_conditions=self._is_told)  # a quarter of the weights is for them
        network = load_pi3x(str(weights), self._placement.weights_dtype, shape)
        network.chunk = self._config.chunk
        return network

    def _view(self, network: Any, images: Tensor, intrinsics: Array | None) -> View:
        from laser_slam.networks.pi3x import Conditions  # noqa: PLC0415

        known = intrinsics if self._config.intrinsics == "given" else None
        if intrinsics is None or not self._is_told:
            return view_of_points(network(images), known)
        told = images.new_tensor(intrinsics).expand(1, images.shape[1], 3, 3)
        output = network(images, Conditions(intrinsics=told))
        centre = (float(intrinsics[0, 2]), float(intrinsics[1, 2]))
        return view_of_points(output, known, centre)
