"""Dense heads: the patch tokens of four levels of a transformer become maps of the image's size.

Reference: Ranftl et al., Vision Transformers for Dense Prediction (arXiv:2103.13413); Wang et al.,
VGGT (arXiv:2503.11651). Modules carry the names of VGGT's released checkpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.dinov2 import PATCH

NORM_EPS = 1e-5
NUM_LEVELS = 4
LAST_WIDTH = 32  # channels before the last convolution
POSITION_WEIGHT = 0.1  # of the embedded positions, beside features
LONGEST_WAVE = 100.0  # ratio of the slowest to the fastest wave of an embedded position


@dataclass(frozen=True)
class DptConfig:
    """The shape of a dense head; the defaults are those of VGGT's released checkpoint.

    Attributes:
        channels: of each level's maps, finest first, before they are fused.
        features: channels of all maps while they are fused.
    """

    channels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    features: int = 256


class DenseHead(nn.Module):
    """Turn tokens into maps, coarse to fine."""

    def __init__(self, width: int, num_outputs: int, config: DptConfig) -> None:
        """Build a head for tokens of ``width`` channels and maps of ``num_outputs``."""
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)
        self.projects = nn.ModuleList(nn.Conv2d(width, count, 1) for count in config.channels)
        first, second, _, fourth = config.channels
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(first, first, 4, stride=4),
                nn.ConvTranspose2d(second, second, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(fourth, fourth, 3, stride=2, padding=1),
            ]
        )
        self.scratch = Scratch(num_outputs, config)

    def forward(self, levels: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        """Return (B, num_outputs, H, W) maps, not activated.

        Args:
            levels: four of (B, h w, D) patch tokens, row by row, the earliest block's first; in any
                dtype.
            size: (H, W) of the image, px: multiples of ``PATCH``.
        """
        maps = [self._lift(index, level, size) for index, level in enumerate(levels)]
        out: Tensor = self.scratch(maps, size)
        return out

    def _lift(self, index: int, tokens: Tensor, size: tuple[int, int]) -> Tensor:
        """Return the (B, C, ...) maps of a level, at its own resolution."""
        tokens = self.norm(tokens.to(self.norm.weight.dtype)).mT
        maps = tokens.reshape(*tokens.shape[:2], size[0] // PATCH, size[1] // PATCH)
        maps = add_positions(self.projects[index](maps), size[1] / size[0])
        out: Tensor = self.resize_layers[index](maps)
        return out


class Scratch(nn.Module):
    """The part of a dense head that fuses maps of four resolutions."""

    def __init__(self, num_outputs: int, config: DptConfig) -> None:
        """Build it for maps of ``num_outputs``."""
        super().__init__()
        features = config.features
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = (
            nn.Conv2d(count, features, 3, padding=1, bias=False) for count in config.channels
        )
        self.refinenet1 = Fusion(features)
        self.refinenet2 = Fusion(features)
        self.refinenet3 = Fusion(features)
        self.refinenet4 = Fusion(features, has_skip=False)
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, LAST_WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(LAST_WIDTH, num_outputs, 1),
        )

    def forward(self, levels: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        """Return (B, num_outputs, *size) for four of (B, C, ...) maps, the finest first."""
        first, second, third = (
            layer(maps)
            for layer, maps in zip(
                (self.layer1_rn, self.layer2_rn, self.layer3_rn), levels[:3], strict=True
            )
        )
        fused = self.refinenet4(self.layer4_rn(levels[3]), None, third.shape[-2:])
        fused = self.refinenet3(fused, third, second.shape[-2:])
        fused = self.refinenet2(fused, second, first.shape[-2:])
        fused = self.refinenet1(fused, first, [2 * side for side in first.shape[-2:]])
        maps = add_positions(resize(self.output_conv1(fused), size), size[1] / size[0])
        out: Tensor = self.output_conv2(maps)
        return out


class Fusion(nn.Module):
    """Add finer maps to coarser ones and enlarge the sum."""

    def __init__(self, features: int, *, has_skip: bool = True) -> None:
        """Build it for maps of ``features`` channels; the coarsest have none to be added."""
        super().__init__()
        if has_skip:
            self.resConfUnit1 = Residual(features)
        self.resConfUnit2 = Residual(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, deep: Tensor, skip: Tensor | None, size: Sequence[int]) -> Tensor:
        """Return (B, C, *size) for (B, C, h, w) ``deep`` and, at the same resolution, ``skip``."""
        if skip is not None:
            deep = deep + self.resConfUnit1(skip)
        out: Tensor = self.out_conv(resize(self.resConfUnit2(deep), size))
        return out


class Residual(nn.Module):
    """Two convolutions beside a connection that passes on what is positive only.

    Differs: not the textbook's residual unit, whose connection passes on everything. The original
    rectifies its input in place, so that the connection sees the result, and was trained so.
    """

    def __init__(self, features: int) -> None:
        """Build it for maps of ``features`` channels."""
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, C, h, w) for (B, C, h, w)."""
        positive = functional.relu(maps)
        out: Tensor = positive + self.conv2(functional.relu(self.conv1(positive)))
        return out


def resize(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Return (B, C, ...) maps as (B, C, *size); corner pixels stay in their corners."""
    return functional.interpolate(maps, size=tuple(size), mode="bilinear", align_corners=True)


def add_positions(maps: Tensor, aspect: float) -> Tensor:
    """Add embedded positions, of a small weight, to (B, C, h, w) maps of an image."""
    rows, columns = maps.shape[-2:]
    of_x, of_y = embed_positions(maps.shape[1], (rows, columns), aspect)
    table = torch.cat(
        [
            of_x.to(maps)[:, None, :].expand(-1, rows, -1),
            of_y.to(maps)[:, :, None].expand(-1, -1, columns),
        ]
    )
    return torch.add(maps, table, alpha=POSITION_WEIGHT)


def embed_positions(
    num_channels: int, grid: tuple[int, int], aspect: float
) -> tuple[Tensor, Tensor]:
    """Write where columns and rows lie as waves of many lengths.

    Args:
        num_channels: C, a multiple of four; one half is for columns, the other for rows.
        grid: (rows, columns) of cells that cover the image.
        aspect: of the image, width over height.

    Returns:
        float32 (C/2, columns) of x and (C/2, rows) of y: sines, then cosines.
    """
    y, x = spread_cells(grid, aspect)
    count = num_channels // 4
    frequencies = LONGEST_WAVE ** (-torch.arange(count, dtype=torch.float64) / count)
    return _waves(frequencies, x), _waves(frequencies, y)


def spread_cells(grid: tuple[int, int], aspect: float) -> tuple[Tensor, Tensor]:
    """Return float64 (rows,) of y and (columns,) of x of cells' centres; half diagonals."""
    half_height = (1 + aspect**2) ** -0.5
    sides = zip(grid, (half_height, half_height * aspect), strict=True)
    y, x = (
        torch.arange(1 - count, count, 2, dtype=torch.float64) * (half / count)
        for count, half in sides
    )
    return y, x


def _waves(frequencies: Tensor, positions: Tensor) -> Tensor:
    """Return (2 F, P) float32: sines, then cosines, of F frequencies at P positions."""
    angles = frequencies[:, None] * positions
    return torch.cat([angles.sin(), angles.cos()]).float()
