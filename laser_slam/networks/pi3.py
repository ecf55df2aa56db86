"""pi3: images of a window, in any order, to the points that their pixels see and their poses.

Reference: Wang et al., pi3: Permutation-Equivariant Visual Geometry Learning (arXiv:2507.13347).
Modules carry the names of the released checkpoint.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from laser_slam.networks.dinov2 import NORMALISATION
from laser_slam.networks.heads import PixelHead, points_on_rays
from laser_slam.networks.placement import full_precision
from laser_slam.networks.trunk import (
    NUM_SPECIAL,
    Layout,
    Pi3Config,
    Trunk,
    keeps_full_precision,
)
from laser_slam.networks.weights import Checkpoint, load_weights

SHAPE = Pi3Config()  # of the released checkpoint

__all__ = ["RELEASED", "Pi3", "Pi3Config", "Pi3Output", "load_pi3"]

RELEASED = Checkpoint(
    setting="backbone.pi3.weights",
    file="model.safetensors",
    url="https://huggingface.co/yyfz233/Pi3",
    size="3.84 GB",
    licence="CC BY-NC 4.0",
    repo="yyfz233/Pi3",
)


class Pi3Output(NamedTuple):
    """What the network says of B windows of N frames, in a unit of each window's own.

    Attributes:
        local_points: (B, N, H, W, 3) float32 in camera axes; z is positive.
        confidence: (B, N, H, W) float32 logits.
        window_from_cam: (B, N, 4, 4) float32, rigid; the window's axes are no camera's.
        tokens: (B, N, D) float32 of each image alone: the mean of its encoded patches.
    """

    local_points: Tensor
    confidence: Tensor
    window_from_cam: Tensor
    tokens: Tensor


class Pi3(Trunk):
    """Points, confidence and poses of the frames of a window.

    Attributes:
        chunk: frames that the heads take at once, which bounds their memory and changes no value;
            None: all.
    """

    def __init__(self, config: Pi3Config, chunk: int | None = None) -> None:
        """Build the network; its weights are to be loaded."""
        super().__init__(config)
        self.chunk = chunk
        self.point_head = PixelHead(config.encoder.width, 3)
        self.conf_head = PixelHead(config.encoder.width, 1)

    def forward(self, images: Tensor) -> Pi3Output:
        """Predict windows.

        Args:
            images: (B, N, 3, H, W) RGB in [0, 1]; H and W are multiples of 14.

        Raises:
            ValueError: H or W is no multiple of 14.
        """
        layout = self.layout(images)
        patches = self.encode(images)
        tokens = patches.mean(dim=1, dtype=torch.float32)
        hidden = self.decode(patches, layout)
        chunks = [self._predict(part, layout) for part in hidden.chunks(self.chunk)]
        outputs = [torch.cat(parts) for parts in zip(*chunks, strict=True)]
        return Pi3Output(*(layout.of_frames(part) for part in [*outputs, tokens]))

    def _predict(self, hidden: Tensor, layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
        """Return points, confidence and poses of F frames for (F, T, 2 D) tokens."""
        points = self.point_decoder(hidden, layout.rotation)[:, NUM_SPECIAL:]
        confidence = self.conf_decoder(hidden, layout.rotation)[:, NUM_SPECIAL:]
        with full_precision(hidden):
            raw = self.point_head(points.float(), layout.grid)
            logits = self.conf_head(confidence.float(), layout.grid)
            local_points = points_on_rays(raw[..., :2], raw[..., 2:])
        return local_points, logits[..., 0], self.locate(hidden, layout)


def load_pi3(path: str, dtype: torch.dtype = torch.float32, config: Pi3Config = SHAPE) -> Pi3:
    """Build the network with the weights of a released or retrained checkpoint.

    Args:
        path: of the file.
        dtype: of encoder and decoders; the heads stay in float32.
        config: the shape of the network that the file is of.

    Raises:
        WeightsError: the file is not there, cannot be read or is of another network.
    """
    with torch.device("meta"):  # takes no memory and no time
        network = Pi3(config)
    load_weights(
        network,
        path,
        RELEASED,
        constants=NORMALISATION,
        dtype=lambda key: torch.float32 if keeps_full_precision(key) else dtype,
    )
    return network.requires_grad_(requires_grad=False).eval()
