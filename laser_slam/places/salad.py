"""The descriptor of DINOv2-SALAD, for users who have its weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from laser_slam.config import PlacesConfig
from laser_slam.dependencies import import_torch
from laser_slam.types import Image


class SaladDescriptor:
    """Describe an image by a network that was trained to tell places, whatever light and season.

    Reference: Izquierdo and Civera, CVPR 2024 (arXiv:2311.15937).
    Differs: float32, or bfloat16 with the transport in float32; VGGT-Long and LASER take float16.
    """

    def __init__(self, config: PlacesConfig) -> None:
        """Load the weights, to the GPU where there is one.

        Raises:
            DependencyError: PyTorch is not installed.
            WeightsError: the file is not set, not there, or not that of SALAD.
        """
        self._torch = import_torch()
        from laser_slam.networks.salad import load_salad  # noqa: PLC0415  (needs torch)

        self._side = config.salad_size
        self._device = "cuda" if self._torch.cuda.is_available() else "cpu"
        dtype = getattr(self._torch, config.salad_dtype)
        self._network = load_salad(config.salad_weights, dtype).to(self._device)

    @property
    def size(self) -> int:
        """Return the length D of its vectors: 8448."""
        return self._network.size

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Describe one (H, W, 3) RGB image as (D,) of unit length, or zeros if of one colour."""
        if np.ptp(image, axis=(0, 1)).max() == 0:
            return np.zeros(self.size, np.float32)
        pixels = self._torch.from_numpy(squared(image, self._side)).to(self._device)
        with self._torch.inference_mode():
            out = self._network(pixels.permute(2, 0, 1)[None] / 255)
        return np.asarray(out[0].cpu().numpy(), np.float32)


def squared(image: Image, side: int) -> Image:
    """Return (side, side, 3) of an RGB image, its aspect given up, as the network was used to."""
    resized = Pillow.fromarray(image).resize((side, side), Pillow.Resampling.BILINEAR)
    return np.array(resized)
