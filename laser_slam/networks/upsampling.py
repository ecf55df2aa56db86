"""Heads of pi3x: the tokens of a frame become maps of its size, by convolutions in three stages.

Reference: Wang et al., MoGe (arXiv:2410.19115), whose heads are of this kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.dpt import spread_cells

NUM_UV = 2  # channels that say where in the image a cell lies
NUM_RESIDUALS = 2  # of a stage
GROUP = 32  # channels that are normalised together
LAST_WIDTH = 32  # channels before the last convolution


class UpsamplingHead(nn.Module):
    """Each stage doubles rows and columns; the last maps are resized to the image."""

    def __init__(self, width: int, num_outputs: Sequence[int], channels: Sequence[int]) -> None:
        """Build a head.

        Args:
            width: channels of the tokens.
            num_outputs: channels of each branch's maps.
            channels: of each stage's maps.
        """
        super().__init__()
        widths = [width, *channels]
        self.upsample_blocks = nn.ModuleList(
            _make_stage(before, after) for before, after in pairwise(widths)
        )
        self.output_block = nn.ModuleList(
            nn.Sequential(
                _convolution(widths[-1] + NUM_UV, LAST_WIDTH),
                nn.ReLU(),
                nn.Conv2d(LAST_WIDTH, count, 1),
            )
            for count in num_outputs
        )

    def forward(self, patches: Tensor, grid: tuple[int, int], size: tuple[int, int]) -> Tensor:
        """Return (F, H, W, sum of num_outputs) maps.

        Args:
            patches: (F, P, D) tokens, row by row.
            grid: rows and columns of the patches.
            size: H and W of the image, px.
        """
        maps = patches.mT.reshape(len(patches), -1, *grid)
        aspect = size[1] / size[0]
        for stage in self.upsample_blocks:
            maps = stage(add_uv(maps, aspect))
        maps = add_uv(functional.interpolate(maps, size=size, mode="bilinear"), aspect)
        return torch.cat([branch(maps) for branch in self.output_block], dim=1).movedim(1, -1)


class _Residual(nn.Module):
    """Two normalised convolutions beside a connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.GroupNorm(1, channels),
            nn.ReLU(),
            _convolution(channels, 2 * channels),
            nn.GroupNorm(2 * channels // GROUP, 2 * channels),
            nn.ReLU(),
            _convolution(2 * channels, channels),
        )

    def forward(self, maps: Tensor) -> Tensor:
        out: Tensor = maps + self.layers(maps)
        return out


def add_uv(maps: Tensor, aspect: float) -> Tensor:
    """Return (F, C + 2, h, w) for (F, C, h, w) maps: where columns, then rows lie in the image.

    Args:
        maps: of cells that cover the image.
        aspect: of the image, width over height.
    """
    y, x = spread_cells((maps.shape[-2], maps.shape[-1]), aspect)
    table = torch.stack(torch.meshgrid(x.to(maps), y.to(maps), indexing="xy"))
    return torch.cat([maps, table.expand(len(maps), -1, -1, -1)], dim=1)


def _make_stage(before: int, after: int) -> nn.Sequential:
    enlarge = nn.ConvTranspose2d(before + NUM_UV, after, 2, stride=2)
    residuals = (_Residual(after) for _ in range(NUM_RESIDUALS))
    return nn.Sequential(nn.Sequential(enlarge, _convolution(after, after)), *residuals)


def _convolution(before: int, after: int) -> nn.Conv2d:
    return nn.Conv2d(before, after, 3, padding=1, padding_mode="replicate")
