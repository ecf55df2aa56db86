"""Rotary positions: channels of queries and keys turned by angles that grow with the position.

What attention then sees of two tokens' positions is their difference alone.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BASE = 100.0  # of the frequencies; text models have 10000, images are not as wide


class Rotation(NamedTuple):
    """Cosines and sines for T positions, ready for use in every block.

    Attributes:
        cos: (T, C), float32, for each channel of a head.
        sin: (T, C), float32; of each pair's first channel negative.
    """

    cos: Tensor
    sin: Tensor

    def repeat(self, count: int) -> Rotation:
        """Return the (count T, C) rotation of ``count`` frames that share their positions."""
        return Rotation(self.cos.repeat(count, 1), self.sin.repeat(count, 1))


def grid_positions(
    rows: int, columns: int, num_special: int = 0, *, device: torch.device | None = None
) -> Tensor:
    """Return where an image's tokens are: special ones at the origin, then patches, row by row.

    Returns:
        (num_special + rows columns, 2) float32 of (y, x), counted from 1 for patches.

    >>> grid_positions(1, 2, num_special=1).tolist()
    [[0.0, 0.0], [1.0, 1.0], [1.0, 2.0]]
    """
    y = torch.arange(1, rows + 1, device=device, dtype=torch.float32)
    x = torch.arange(1, columns + 1, device=device, dtype=torch.float32)
    patches = torch.cartesian_prod(y, x)
    return torch.cat([patches.new_zeros(num_special, 2), patches])


def make_rotation(positions: Tensor, channels: int) -> Rotation:
    """Precompute the rotation of heads of ``channels`` channels.

    Args:
        positions: (T, A) along each of A axes; negative ones turn the other way.
        channels: of a head; the axes share them in turn, and each axis pairs the first half of
            its own with the second.

    Reference: Su et al., RoFormer (arXiv:2104.09864). Differs: an axis after the other.
    """
    per_axis = channels // positions.shape[1]
    steps = torch.arange(0, per_axis, 2, device=positions.device, dtype=torch.float32)
    angles = positions.float()[:, :, None] * BASE ** (-steps / per_axis)  # (T, A, per_axis / 2)
    cos, sin = angles.cos(), angles.sin()
    return Rotation(torch.cat([cos, cos], -1).flatten(1), torch.cat([-sin, sin], -1).flatten(1))


def rotate(heads: Tensor, rotation: Rotation, num_axes: int = 2) -> Tensor:
    """Turn the channels of (..., T, C) queries or keys, whose dtype stays."""
    halves = heads.view(*heads.shape[:-1], num_axes, 2, -1)
    swapped = halves.flip(-2).flatten(-3)
    cos, sin = rotation.cos.to(heads.dtype), rotation.sin.to(heads.dtype)
    return torch.addcmul(heads * cos, swapped, sin)
