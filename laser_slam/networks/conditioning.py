"""What pi3x may be told beside the images: depths, rays of the pixels, poses of the cameras."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from laser_slam.networks.rope import Rotation, make_rotation, rotate
from laser_slam.networks.transformer import Attention, BlockConfig, Perceptron, make_scale

STILL = 0.02  # length of all translations below which there is no unit in them


class Conditions(NamedTuple):
    """What is known of B windows of N frames; None: nothing of that kind.

    Attributes:
        depths: (B, N, H, W) z along the optical axis; NaN or not positive: unknown.
        intrinsics: (B, N, 3, 3) in pixels of the images, whose centres are at integers.
        world_from_cam: (B, N, 4, 4) rigid, in the unit of the depths; of two frames or more. The
            network was trained with poses only where it was told intrinsics, too.
    """

    depths: Tensor | None = None
    intrinsics: Tensor | None = None
    world_from_cam: Tensor | None = None


def mean_depths(depths: Tensor) -> Tensor:
    """Return (B,) means of the known depths of windows; 1 where none is."""
    known = depths > 0  # NaN is not
    sums = torch.where(known, depths, 0).sum(dim=(1, 2, 3))
    counts = known.sum(dim=(1, 2, 3))
    return torch.where(counts > 0, sums / counts.clamp(min=1), torch.ones_like(sums))


def depth_maps(depths: Tensor, means: Tensor) -> Tensor:
    """Return (B N, 2, H, W): depths in units of their window's mean, and where they are known."""
    known = depths > 0
    scaled = torch.where(known, depths / means[:, None, None, None], 0)
    return torch.stack([scaled, known.to(depths.dtype)], dim=2).flatten(0, 1)


def ray_maps(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Return (B N, 2, H, W) slopes x/z and y/z of the rays of the pixels of (B, N, 3, 3)."""
    device = intrinsics.device
    v, u = (torch.arange(side, device=device, dtype=torch.float32) for side in size)
    pixels = torch.stack([*torch.meshgrid(u, v, indexing="xy"), torch.ones(size, device=device)])
    inverse: Tensor = torch.linalg.inv(intrinsics.float().flatten(0, 1))
    return torch.einsum("fij,jhw->fihw", inverse[:, :2], pixels)


def relative_poses(world_from_cam: Tensor, mean_depths: Tensor | None) -> Tensor:
    """Return (B, N, 4, 4) poses in the first camera's axes and in a unit of the window's own.

    Args:
        world_from_cam: (B, N, 4, 4) rigid.
        mean_depths: (B,) that become the unit; None: the mean distance of the other cameras from
            the first, unless all stand still.
    """
    first_from_cam = torch.linalg.inv(world_from_cam[:, :1].float()) @ world_from_cam.float()
    units = _mean_distances(first_from_cam) if mean_depths is None else mean_depths
    centres = first_from_cam[..., :3, 3:] / units[:, None, None, None]
    upper = torch.cat([first_from_cam[..., :3, :3], centres], dim=-1)
    return torch.cat([upper, first_from_cam[..., 3:, :]], dim=-2)


def _mean_distances(first_from_cam: Tensor) -> Tensor:
    distances: Tensor = first_from_cam[:, 1:, :3, 3].norm(dim=-1)
    is_still = (distances < STILL).all(dim=1)
    return torch.where(is_still, 1, distances.mean(dim=1))


class CameraFrames(NamedTuple):
    """What turns heads of patch tokens from their cameras' axes into the window's, and back.

    Attributes:
        window_from_cam: (B, N, 4, 4) rigid.
        cam_from_window: (B, N, 4, 4), its inverse.
        forth: rotation of the N P patches' positions.
        back: the opposite one.
    """

    window_from_cam: Tensor
    cam_from_window: Tensor
    forth: Rotation
    back: Rotation


def make_camera_frames(
    window_from_cam: Tensor, grid: tuple[int, int], channels: int
) -> CameraFrames:
    """Precompute what attention needs to see cameras.

    Args:
        window_from_cam: (B, N, 4, 4) rigid.
        grid: rows and columns of the patches.
        channels: of a head; half of them see cameras, half see positions in the image.
    """
    device, num_frames = window_from_cam.device, window_from_cam.shape[1]
    y, x = (torch.arange(side, device=device, dtype=torch.float32) for side in grid)
    positions = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)
    back, forth = (
        make_rotation(sign * positions, channels // 2).repeat(num_frames) for sign in (1, -1)
    )
    return CameraFrames(window_from_cam, torch.linalg.inv(window_from_cam), forth, back)


def turn(heads: Tensor, matrices: Tensor, rotation: Rotation) -> Tensor:
    """Return (B, heads, N P, C) with cameras' matrices and positions worked in.

    The first half of the channels, in groups of four, is multiplied by the (B, N, 4, 4) matrix of
    its frame; the second is turned.

    Reference: Li et al., Cameras as Relative Positional Encoding (arXiv:2507.10496).
    """
    seen, placed = heads.chunk(2, dim=-1)
    batch, num_heads, _, channels = seen.shape
    groups = seen.reshape(batch, num_heads, matrices.shape[1], -1, channels // 4, 4)
    moved = torch.einsum("bnij,bhnpgj->bhnpgi", matrices.to(heads.dtype), groups)
    return torch.cat([moved.reshape(seen.shape), rotate(placed, rotation)], dim=-1)


class PoseInjection(nn.Module):
    """What the patches of all frames learn from one another's cameras, to be added to them."""

    def __init__(self, config: BlockConfig) -> None:
        """Build it; its weights are to be loaded."""
        super().__init__()
        self.norm1 = nn.LayerNorm(config.width, eps=config.eps)
        self.attn = CameraAttention(config)
        self.ls1 = make_scale(config)
        self.norm2 = nn.LayerNorm(config.width, eps=config.eps)
        self.mlp = Perceptron(config.width)
        self.ls2 = make_scale(config)

    def forward(self, patches: Tensor, frames: CameraFrames) -> Tensor:
        """Return (B, N P, D) for (B, N P, D); both parts see the input, not one the other."""
        seen = self.ls1(self.attn.see(self.norm1(patches), frames))
        out: Tensor = seen + self.ls2(self.mlp(self.norm2(patches)))
        return out


class CameraAttention(Attention):
    """Attention whose heads know where the cameras of two patches stand to one another."""

    def see(self, patches: Tensor, frames: CameraFrames) -> Tensor:
        """Return (B, N P, D) for (B, N P, D)."""
        query, key, value = self.heads(patches)
        # A query is transformed as a row: products with keys are in the window's axes.
        query = turn(query, frames.cam_from_window.mT, frames.forth)
        key, value = (turn(heads, frames.window_from_cam, frames.forth) for heads in (key, value))
        mixed = nn.functional.scaled_dot_product_attention(query, key, value)
        return self.join(turn(mixed, frames.cam_from_window, frames.back))
