"""Heads of pi3 and pi3x: what turns a frame's tokens into points, confidence and a camera."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.dinov2 import PATCH
from laser_slam.networks.rope import Rotation
from laser_slam.networks.transformer import Block, BlockConfig

NUM_RESIDUALS = 2  # of a pose head


class HeadDecoder(nn.Module):
    """A few blocks of a head's own, in which the tokens of a frame see one another."""

    def __init__(self, width_in: int, width_out: int, depth: int, block: BlockConfig) -> None:
        """Build it from ``depth`` blocks between two linear layers."""
        super().__init__()
        self.projects = nn.Linear(width_in, block.width)
        self.blocks = nn.ModuleList(Block(block) for _ in range(depth))
        self.linear_out = nn.Linear(block.width, width_out)

    def forward(self, tokens: Tensor, rotation: Rotation) -> Tensor:
        """Return (F, T, width_out) for (F, T, width_in) tokens of F frames."""
        tokens = self.projects(tokens)
        for block in self.blocks:
            tokens = block(tokens, rotation)
        out: Tensor = self.linear_out(tokens)
        return out


class PixelHead(nn.Module):
    """All values of a patch's pixels from its token, by one linear layer."""

    def __init__(self, width: int, num_outputs: int) -> None:
        """Build it for tokens of ``width`` channels."""
        super().__init__()
        self.proj = nn.Linear(width, num_outputs * PATCH**2)

    def forward(self, patches: Tensor, grid: tuple[int, int]) -> Tensor:
        """Return (F, H, W, num_outputs) maps for (F, P, width) tokens of (rows, columns)."""
        maps = self.proj(patches).mT.unflatten(-1, grid)
        return functional.pixel_shuffle(maps, PATCH).movedim(1, -1)


class PoseHead(nn.Module):
    """A frame's pose from the mean of its patches."""

    def __init__(self, width: int) -> None:
        """Build it for tokens of ``width`` channels."""
        super().__init__()
        self.res_conv = nn.ModuleList(_Residual(width) for _ in range(NUM_RESIDUALS))
        self.more_mlps = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.fc_t = nn.Linear(width, 3)
        self.fc_rot = nn.Linear(width, 9)

    def forward(self, patches: Tensor) -> Tensor:
        """Return (F, 4, 4) rigid poses, window from camera, for (F, P, width) tokens."""
        for residual in self.res_conv:
            patches = residual(patches)
        pooled = self.more_mlps(patches.mean(dim=1))
        rotations = nearest_rotations(self.fc_rot(pooled).unflatten(-1, (3, 3)))
        upper = torch.cat([rotations, self.fc_t(pooled)[:, :, None]], dim=2)
        lower = torch.eye(4, device=upper.device)[3:].expand(len(upper), -1, -1)
        return torch.cat([upper, lower], dim=1)


class _Residual(nn.Module):
    """Three linear layers on each token by itself, beside a connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.res_conv1 = nn.Linear(width, width)
        self.res_conv2 = nn.Linear(width, width)
        self.res_conv3 = nn.Linear(width, width)

    def forward(self, patches: Tensor) -> Tensor:
        hidden = functional.relu(self.res_conv1(patches))
        hidden = functional.relu(self.res_conv2(hidden))
        return patches + functional.relu(self.res_conv3(hidden))


def nearest_rotations(matrices: Tensor) -> Tensor:
    """Return the rotations nearest to (F, 3, 3) matrices whose rows are scaled to unit length.

    Reference: Levinson et al., An Analysis of SVD for Deep Rotation Estimation (arXiv:2006.14616).
    """
    left, _, right = torch.linalg.svd(functional.normalize(matrices, dim=-1))
    signs = torch.ones_like(matrices[:, 0])
    signs[:, 2] = torch.linalg.det(left @ right)
    rotations: Tensor = left * signs[:, None] @ right
    return rotations


def points_on_rays(slopes: Tensor, log_depths: Tensor) -> Tensor:
    """Return (..., 3) camera points for (..., 2) slopes x/z, y/z and (..., 1) logarithms of z."""
    depths = log_depths.exp()
    return torch.cat([slopes * depths, depths], dim=-1)


def pose_points(rigid: Tensor, points: Tensor) -> Tensor:
    """Return (..., H, W, 3) points moved by (..., 4, 4) poses."""
    turned: Tensor = torch.einsum("...ij,...hwj->...hwi", rigid[..., :3, :3], points)
    return turned + rigid[..., None, None, :3, 3]
