"""The image encoder that SALAD, pi3 and VGGT share: a DINOv2 vision transformer.

Modules carry the names of the released checkpoints, so that no key needs a mapping: below
``backbone.model.`` of SALAD's, ``encoder.`` of pi3's and ``aggregator.patch_embed.`` of VGGT's.
The ``mask_token`` that some of them hold serves training only and has no place here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.transformer import Block, BlockConfig

IMAGE_MEAN = (0.485, 0.456, 0.406)  # of ImageNet: red, green, blue in [0, 1]
IMAGE_STD = (0.229, 0.224, 0.225)
NORMALISATION = {"image_mean": IMAGE_MEAN, "image_std": IMAGE_STD}  # as some checkpoints hold them
PATCH = 14  # side, px
COLOURS = 3
NORM_EPS = 1e-6
UNABLE = {"mps"}  # devices where not every PyTorch resamples; the table is small
EXTRA = 0.1  # cells; part of the factor by which 'factor' resamples


@dataclass(frozen=True)
class EncoderConfig:
    """The shape of an encoder, and how it places images that are not of its training size.

    Attributes:
        width: channels D of a token.
        depth: number of blocks.
        num_heads: of the attention; they share the width.
        num_registers: extra tokens between the class token and the patches.
        grid: side of the table of positions, in patches.
        channels: of the maps; 3: RGB images in [0, 1], which are normalised first.
        resampling: of that table. 'size': to the image's grid, smoothed (pi3, VGGT); 'factor': by
            (cells + 0.1) / grid, not smoothed (the first DINOv2, thus SALAD). A network is right
            with the one that it was trained with only.
    """

    width: int
    depth: int
    num_heads: int
    num_registers: int = 0
    grid: int = 37
    channels: int = 3
    resampling: Literal["size", "factor"] = "size"


BASE = EncoderConfig(768, 12, 12, resampling="factor")  # ViT-B/14
LARGE_WITH_REGISTERS = EncoderConfig(1024, 24, 16, num_registers=4)  # ViT-L/14


class Tokens(NamedTuple):
    """What the encoder says of B images.

    Attributes:
        image: (B, D) of the class token.
        patches: (B, h w, D), row by row, of the patches.
    """

    image: Tensor
    patches: Tensor


class Encoder(nn.Module):
    """A vision transformer with registers and scaled residual branches.

    Reference: Oquab et al., DINOv2 (arXiv:2304.07193); Darcet et al. (arXiv:2309.16588, registers).
    """

    def __init__(self, config: EncoderConfig) -> None:
        """Build the encoder with zeros for weights, which are to be loaded."""
        super().__init__()
        width = config.width
        self.config = config
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid**2, width))
        if config.num_registers:
            self.register_tokens = nn.Parameter(torch.zeros(1, config.num_registers, width))
        is_coloured = config.channels == COLOURS
        self.patch_embed = (
            ImageEmbedding(width) if is_coloured else PatchEmbedding(width, config.channels)
        )
        shape = BlockConfig(width, config.num_heads, eps=NORM_EPS)
        self.blocks = nn.ModuleList(Block(shape) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)

    def forward(self, images: Tensor) -> Tokens:
        """Encode images of one size.

        Args:
            images: (B, channels, H, W), three being RGB in [0, 1]; H and W are multiples of
                ``PATCH``.

        Returns:
            Normalised tokens, in the dtype of the weights or of a surrounding autocast.

        Raises:
            ValueError: H or W is no multiple of ``PATCH``.
        """
        tokens = self.embed(images)
        for block in self.blocks:
            tokens = block(tokens)
        tokens = self.norm(tokens)
        return Tokens(tokens[:, 0], tokens[:, 1 + self.config.num_registers :])

    def embed(self, images: Tensor) -> Tensor:
        """Return the (B, 1 + registers + h w, D) tokens that go into the first block."""
        height, width = images.shape[-2:]
        if height % PATCH or width % PATCH:
            raise ValueError(f"images of {width}x{height} px; sides must be multiples of {PATCH}")
        patches = self.patch_embed(images)
        tokens = torch.cat([self.cls_token.expand(len(images), -1, -1).to(patches), patches], dim=1)
        tokens = tokens + self.positions(height // PATCH, width // PATCH).to(tokens)
        if not self.config.num_registers:
            return tokens
        registers = self.register_tokens.expand(len(images), -1, -1).to(tokens)
        return torch.cat([tokens[:, :1], registers, tokens[:, 1:]], dim=1)

    def positions(self, rows: int, columns: int) -> Tensor:
        """Return the (1, 1 + rows columns, D) table of positions, the class token's first."""
        grid = self.config.grid
        if rows == columns == grid:
            return self.pos_embed
        device = self.pos_embed.device
        table = self.pos_embed.float().to("cpu" if device.type in UNABLE else device)
        square = table[:, 1:].transpose(1, 2).reshape(1, -1, grid, grid)
        resampled = self._resample(square, rows, columns).flatten(2).transpose(1, 2)
        return torch.cat([table[:, :1], resampled], dim=1).to(device)

    def _resample(self, square: Tensor, rows: int, columns: int) -> Tensor:
        """Resample (1, D, grid, grid) to (1, D, rows, columns)."""
        if self.config.resampling == "size":
            return functional.interpolate(
                square, size=(rows, columns), mode="bicubic", antialias=True
            )
        factors = ((rows + EXTRA) / self.config.grid, (columns + EXTRA) / self.config.grid)
        return functional.interpolate(square, scale_factor=factors, mode="bicubic")


class PatchEmbedding(nn.Module):
    """A token for each patch of a map, from its pixels alone."""

    def __init__(self, width: int, channels: int = COLOURS) -> None:
        """Build it for tokens of ``width`` channels, from maps of ``channels``."""
        super().__init__()
        self.proj = nn.Conv2d(channels, width, PATCH, stride=PATCH)

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, h w, D) tokens, row by row, of (B, channels, H, W) maps."""
        tokens: Tensor = self.proj(maps.to(self.proj.weight.dtype))
        return tokens.flatten(2).transpose(1, 2)


class ImageEmbedding(PatchEmbedding):
    """A token for each patch of an image, whose colours are normalised first."""

    def forward(self, images: Tensor) -> Tensor:
        """Return (B, h w, D) tokens, row by row, of (B, 3, H, W) images in [0, 1]."""
        return super().forward(normalise(images))


def normalise(images: Tensor) -> Tensor:
    """Return (..., 3, H, W) in [0, 1] as the networks were trained: ImageNet's mean and spread."""
    mean = torch.tensor(IMAGE_MEAN, device=images.device).view(3, 1, 1)
    std = torch.tensor(IMAGE_STD, device=images.device).view(3, 1, 1)
    return (images - mean) / std
