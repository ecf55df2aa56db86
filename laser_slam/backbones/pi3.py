"""pi3: points of each pixel in its camera's axes, and poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.feedforward import NetworkBackbone, View, fit_camera
from laser_slam.config import BackboneConfig

if TYPE_CHECKING:
    from torch import Tensor

    from laser_slam.networks.pi3 import Pi3, Pi3Output
    from laser_slam.networks.weights import Checkpoint

Array = NDArray[np.float64]


class Pi3Backbone(NetworkBackbone):
    """pi3 (Wang et al., arXiv:2507.13347): all frames alike, none is the reference.

    Its unit is the window's own. Depth is its points' z; the focal lengths are those that its
    points agree on, the principal point is the image's centre.
    """

    name = "pi3"

    def __init__(self, config: BackboneConfig, network: Pi3 | None = None) -> None:
        super().__init__(config.pi3, network)

    def _checkpoint(self) -> Checkpoint:
        from laser_slam.networks.pi3 import RELEASED  # noqa: PLC0415  (needs torch)

        return RELEASED

    def _load(self, weights: Path) -> Any:
        from laser_slam.networks.pi3 import load_pi3  # noqa: PLC0415

        network = load_pi3(str(weights), self._placement.weights_dtype)
        network.chunk = self._config.chunk
        return network

    def _view(self, network: Any, images: Tensor, intrinsics: Array | None) -> View:
        known = intrinsics if self._config.intrinsics == "given" else None
        return view_of_points(network(images), known)


def view_of_points(
    output: Pi3Output, known: Array | None = None, centre: tuple[float, float] | None = None
) -> View:
    """Read what pi3 or pi3x says of one window.

    Args:
        output: with B = 1.
        known: (3, 3) intrinsics in pixels, taken as they are; None: they are fitted.
        centre: x, y of the principal point, px; None: the middle of the image.
    """
    points = output.local_points[0].cpu().numpy()
    confidence = output.confidence[0].sigmoid().cpu().numpy()
    height, width = confidence.shape[1:]
    middle = ((width - 1) / 2, (height - 1) / 2) if centre is None else centre
    return View(
        points[..., 2],
        confidence,
        output.window_from_cam[0].cpu().double().numpy(),
        fit_camera(points, confidence, middle) if known is None else known,
        output.tokens[0].cpu().numpy(),
    )
