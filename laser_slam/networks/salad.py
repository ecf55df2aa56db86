"""DINOv2-SALAD: an image to one vector, by optimal transport of its patches to clusters.

Written from the paper; keys are those of the released ``dino_salad.ckpt``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.dinov2 import BASE, PATCH, Encoder, EncoderConfig
from laser_slam.networks.weights import Checkpoint, load_weights

ITERATIONS = 3  # of the transport, as trained

RELEASED = Checkpoint(
    setting="places.salad_weights",
    file="dino_salad.ckpt",
    url="https://github.com/serizba/salad/releases/download/v1.0.0/dino_salad.ckpt",
    size="352 MB",
    licence="GPL-3.0",
)


@dataclass(frozen=True)
class SaladConfig:
    """The shape of the network; the defaults are those of the released checkpoint.

    Attributes:
        encoder: of the image.
        num_clusters: m that patches are given to.
        cluster_width: numbers that a patch leaves with its cluster.
        image_width: numbers that the whole image adds.
        hidden_width: of the two-layer perceptrons.
    """

    encoder: EncoderConfig = BASE
    num_clusters: int = 64
    cluster_width: int = 128
    image_width: int = 256
    hidden_width: int = 512


class Salad(nn.Module):
    """Describe images as vectors of unit length."""

    def __init__(self, config: SaladConfig) -> None:
        """Build the network; its weights are to be loaded."""
        super().__init__()
        self.size = config.image_width + config.cluster_width * config.num_clusters
        self.backbone = Backbone(config.encoder)
        self.aggregator = Aggregator(config)

    def forward(self, images: Tensor) -> Tensor:
        """Describe (B, 3, H, W) RGB images in [0, 1] as (B, size) float32 of unit length.

        Raises:
            ValueError: H or W is no multiple of 14, or there are no more patches than clusters.
        """
        tokens = self.backbone.model(images)
        rows, columns = (side // PATCH for side in images.shape[-2:])
        maps = tokens.patches.transpose(1, 2).reshape(len(images), -1, rows, columns)
        out: Tensor = self.aggregator(tokens.image, maps)
        return out


class Backbone(nn.Module):
    """The encoder, one level down, where the released checkpoint has it."""

    def __init__(self, config: EncoderConfig) -> None:
        """Build the encoder."""
        super().__init__()
        self.model = Encoder(config)


class Aggregator(nn.Module):
    """Give patches to clusters by optimal transport and sum up what each cluster gets.

    Reference: Izquierdo and Civera, CVPR 2024 (arXiv:2311.15937).
    """

    def __init__(self, config: SaladConfig) -> None:
        """Build the perceptrons of image, patches and scores."""
        super().__init__()
        width, hidden = config.encoder.width, config.hidden_width
        self.num_clusters = config.num_clusters
        self.token_features = nn.Sequential(
            nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, config.image_width)
        )
        self.cluster_features = _on_maps(width, hidden, config.cluster_width)
        self.score = _on_maps(width, hidden, config.num_clusters)
        self.dust_bin = nn.Parameter(torch.zeros(()))

    def forward(self, image: Tensor, maps: Tensor) -> Tensor:
        """Sum up an image.

        Args:
            image: (B, D) tokens of the images.
            maps: (B, D, h, w) tokens of their patches.

        Returns:
            (B, size) float32 of unit length: the image's part, then one number of a patch after
            the other, each for all clusters.
        """
        features = self.cluster_features(maps).flatten(2).float()  # (B, l, n)
        scores = self.score(maps).flatten(2).float()  # (B, m, n)
        shares = log_transport(scores, self.dust_bin.float())[:, :-1].exp()
        clusters = functional.normalize(features @ shares.transpose(1, 2), dim=1)  # (B, l, m)
        whole = functional.normalize(self.token_features(image).float(), dim=1)
        return functional.normalize(torch.cat([whole, clusters.flatten(1)], dim=1), dim=1)


class _Marginals(NamedTuple):
    """Logarithms of what clusters, the dustbin and each patch hold in all."""

    rows: Tensor
    patch: float


def log_transport(scores: Tensor, dust_bin: Tensor) -> Tensor:
    """Share patches among clusters, each cluster as many; what is left over goes to a dustbin.

    Args:
        scores: (B, m, n) of n patches for m < n clusters; larger is nearer. float32: the
            iterations lose too much in half precision.
        dust_bin: () score of every patch for the dustbin.

    Returns:
        (B, m + 1, n) logarithms of the shares; the last row is the dustbin's.

    Raises:
        ValueError: there are no more patches than clusters, so that none is left over.
    """
    batch, m, n = scores.shape
    if n <= m:
        raise ValueError(f"{n} patches for {m} clusters: the image is too small")
    held = _marginals(m, n, scores)
    scores = torch.cat([scores, dust_bin.expand(batch, 1, n)], dim=1)
    columns = scores.new_zeros(batch, 1, n)
    for _ in range(ITERATIONS):
        rows = held.rows - torch.logsumexp(scores + columns, dim=2, keepdim=True)
        columns = held.patch - torch.logsumexp(scores + rows, dim=1, keepdim=True)
    return scores + rows + columns - held.patch


def _marginals(m: int, n: int, like: Tensor) -> _Marginals:
    patch = -log(m + n)
    rows = like.new_full((1, m + 1, 1), patch)
    rows[:, -1] += log(n - m)
    return _Marginals(rows, patch)


def load_salad(path: str, dtype: torch.dtype = torch.float32) -> Salad:
    """Build the network with the weights of a released or retrained checkpoint, as ``dtype``.

    Raises:
        WeightsError: the file is not there, cannot be read or is of another network.
    """
    with torch.device("meta"):  # takes no memory and no time
        network = Salad(SaladConfig())
    unused = ("backbone.model.mask_token",)
    load_weights(network, path, RELEASED, unused=unused, dtype=dtype)
    return network.requires_grad_(requires_grad=False).eval()


def _on_maps(width: int, hidden: int, out: int) -> nn.Sequential:
    # The second place was dropout's in training; the last layer's key counts it.
    return nn.Sequential(
        nn.Conv2d(width, hidden, 1), nn.Identity(), nn.ReLU(), nn.Conv2d(hidden, out, 1)
    )
