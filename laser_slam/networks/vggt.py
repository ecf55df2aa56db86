"""VGGT: the frames of a window to depth and cameras, in one pass.

Reference: Wang et al., VGGT: Visual Geometry Grounded Transformer (arXiv:2503.11651). Modules
carry the names of the released checkpoint, so that no key needs a mapping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from laser_slam.networks.camera_head import CameraHead, CameraHeadConfig, decode_cameras
from laser_slam.networks.dinov2 import LARGE_WITH_REGISTERS, PATCH, Encoder, EncoderConfig
from laser_slam.networks.dpt import DenseHead, DptConfig
from laser_slam.networks.placement import full_precision
from laser_slam.networks.rope import grid_positions, make_rotation
from laser_slam.networks.transformer import Block, BlockConfig
from laser_slam.networks.weights import Checkpoint, load_weights

NORM_EPS = 1e-5  # the encoder's differs
NUM_REGISTERS = 4
NUM_SPECIAL = 1 + NUM_REGISTERS  # tokens of a frame before its patches; the camera's is the first

RELEASED = Checkpoint(
    setting="backbone.vggt.weights",
    file="model.safetensors",
    url="https://huggingface.co/facebook/VGGT-1B",
    size="5.03 GB",
    licence="CC BY-NC 4.0; for commercial use, once Meta grants access: vggt_1B_commercial.pt of "
    "facebook/VGGT-1B-Commercial",
    repo="facebook/VGGT-1B",
)
RELEASED_DENSE = DptConfig()
RELEASED_CAMERA = CameraHeadConfig()


@dataclass(frozen=True)
class VggtConfig:
    """The shape of the network; the defaults are those of the released checkpoint.

    Attributes:
        encoder: of each image; its width is that of all tokens.
        depth: pairs of blocks, one within frames and one across them.
        num_heads: of their attention.
        levels: the four pairs that dense heads look at, counted from 0.
        dense: of the heads that make maps.
        camera: of the head that makes cameras.
        point_head: also predict a point of the world for each pixel.
        chunk: frames that the dense heads take at once; None: all. Saves memory, changes nothing.
    """

    encoder: EncoderConfig = LARGE_WITH_REGISTERS
    depth: int = 24
    num_heads: int = 16
    levels: tuple[int, int, int, int] = (4, 11, 17, 23)
    dense: DptConfig = RELEASED_DENSE
    camera: CameraHeadConfig = RELEASED_CAMERA
    point_head: bool = False
    chunk: int | None = 8


class VggtOutput(NamedTuple):
    """What the network says of B windows of N frames, in each window's own unit of length.

    The world is about the first camera; the unit is the mean distance of points, about.

    Attributes:
        depth: (B, N, H, W) z along the optical axis, > 0.
        depth_confidence: (B, N, H, W), >= 1 without limit.
        cam_from_world: (B, N, 4, 4) rigid, camera axes x right, y down, z forward.
        intrinsics: (B, N, 3, 3), px; the principal point is (W/2, H/2). Infinite focal lengths
            where it sees no angle of view.
        tokens: (B, N, D) mean of the encoder's patch tokens, which tells places apart.
        points: (B, N, H, W, 3) in the world; None without ``point_head``.
        points_confidence: (B, N, H, W), >= 1; None without ``point_head``.
    """

    depth: Tensor
    depth_confidence: Tensor
    cam_from_world: Tensor
    intrinsics: Tensor
    tokens: Tensor
    points: Tensor | None = None
    points_confidence: Tensor | None = None


class Vggt(nn.Module):
    """Encoder, blocks within and across frames, one head for cameras and one or two for maps."""

    def __init__(self, config: VggtConfig) -> None:
        """Build the network; its weights are to be loaded."""
        super().__init__()
        self.config = config
        width = 2 * config.encoder.width
        self.aggregator = Aggregator(config)
        self.camera_head = CameraHead(width, config.camera)
        self.depth_head = DenseHead(width, 2, config.dense)
        self.point_head = DenseHead(width, 4, config.dense) if config.point_head else None

    def forward(self, images: Tensor) -> VggtOutput:
        """Predict windows.

        The heads work in the dtype of their weights, float32, also inside an autocast.

        Args:
            images: (B, N, 3, H, W) RGB in [0, 1]; H and W are multiples of 14.

        Returns:
            All float32, on the device of the images.

        Raises:
            ValueError: H or W is no multiple of 14.
        """
        seen: Aggregated = self.aggregator(images)
        with full_precision(images):
            return self._read(seen, (images.shape[-2], images.shape[-1]))

    def _read(self, seen: Aggregated, size: tuple[int, int]) -> VggtOutput:
        """Let the heads say what the blocks have seen in images of ``size`` (H, W)."""
        cameras = decode_cameras(self.camera_head(seen.cameras)[-1], size)
        depth = self._make_maps(self.depth_head, seen, size)
        out = VggtOutput(
            depth=depth[:, :, 0].exp(),
            depth_confidence=1 + depth[:, :, 1].exp(),
            cam_from_world=cameras.cam_from_world,
            intrinsics=cameras.intrinsics,
            tokens=seen.tokens,
        )
        if self.point_head is None:
            return out
        raw = self._make_maps(self.point_head, seen, size)
        points = raw[:, :, :3].movedim(2, -1)
        return out._replace(
            points=points.sign() * points.abs().expm1(),
            points_confidence=1 + raw[:, :, 3].exp(),
        )

    def _make_maps(self, head: DenseHead, seen: Aggregated, size: tuple[int, int]) -> Tensor:
        """Return the (B, N, C, H, W) maps of a head, made of some frames after the other."""
        parts = (torch.split(level, self.config.chunk or len(level)) for level in seen.levels)
        maps = torch.cat([head(chunk, size) for chunk in zip(*parts, strict=True)])
        return maps.view(*seen.cameras.shape[:2], *maps.shape[1:])


class Aggregated(NamedTuple):
    """What the heads need of B windows of N frames with h w patches each.

    Attributes:
        levels: four of (B N, h w, 2 D): what blocks within, then across frames say of patches.
        cameras: (B, N, 2 D) of the cameras' tokens after the last pair.
        tokens: (B, N, D) float32: see ``VggtOutput``.
    """

    levels: tuple[Tensor, ...]
    cameras: Tensor
    tokens: Tensor


class Aggregator(nn.Module):
    """Encode each frame, then let tokens see their own frame and all frames in turn."""

    def __init__(self, config: VggtConfig) -> None:
        """Build encoder and blocks."""
        super().__init__()
        width = config.encoder.width
        shape = BlockConfig(width, config.num_heads, eps=NORM_EPS, query_eps=NORM_EPS)
        self.levels = config.levels
        # One for the first frame, which makes the world, and one that all others share.
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, NUM_REGISTERS, width))
        self.patch_embed = Encoder(config.encoder)
        self.frame_blocks = nn.ModuleList(Block(shape) for _ in range(config.depth))
        self.global_blocks = nn.ModuleList(Block(shape) for _ in range(config.depth))
        self.head_width = width // config.num_heads

    def forward(self, images: Tensor) -> Aggregated:
        """Look at (B, N, 3, H, W) images in [0, 1]."""
        batch, num_frames = images.shape[:2]
        tokens, means = self._embed(images)
        positions = grid_positions(
            images.shape[-2] // PATCH, images.shape[-1] // PATCH, NUM_SPECIAL, device=images.device
        )
        in_frame = make_rotation(positions, self.head_width)
        in_all = in_frame.repeat(num_frames)
        levels = []
        pairs = zip(self.frame_blocks, self.global_blocks, strict=True)
        for index, (frame_block, global_block) in enumerate(pairs):
            within = frame_block(tokens, in_frame)
            across = global_block(within.reshape(batch, -1, within.shape[-1]), in_all)
            tokens = across.view_as(within)
            if index in self.levels:
                levels.append(torch.cat([within[:, NUM_SPECIAL:], tokens[:, NUM_SPECIAL:]], -1))
        cameras = torch.cat([within[:, 0], tokens[:, 0]], -1)
        return Aggregated(tuple(levels), cameras.view(batch, num_frames, -1), means)

    def _embed(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return (B N, 5 + h w, D) tokens and the (B, N, D) means of those of patches."""
        patches = self.patch_embed(images.flatten(0, 1)).patches
        means = patches.mean(1, dtype=torch.float32).view(*images.shape[:2], -1)
        special = torch.cat([self.camera_token, self.register_token], 2).to(patches)
        others = special[:, 1:].expand(-1, images.shape[1] - 1, -1, -1)
        frames = torch.cat([special[:, :1], others], 1).expand(len(images), -1, -1, -1)
        return torch.cat([frames.flatten(0, 1), patches], 1), means


SHAPE = VggtConfig()


def load_vggt(path: str, dtype: torch.dtype = torch.float32, config: VggtConfig = SHAPE) -> Vggt:
    """Build the network with the weights of a checkpoint.

    Args:
        path: of the file.
        dtype: of the aggregator's weights; heads stay float32.
        config: of the network that the file is of.

    Raises:
        WeightsError: the file is not there, cannot be read or is of another network.
        DependencyError: a package that reads the file is not installed.
    """
    with torch.device("meta"):  # takes no memory and no time
        network = Vggt(config)
    load_weights(
        network,
        path,
        RELEASED,
        unused=list_unused(config),
        dtype=lambda key: dtype if key.startswith("aggregator.") else torch.float32,
    )
    return network.requires_grad_(requires_grad=False).eval()


def list_unused(config: VggtConfig) -> list[str]:
    """Return keys of the released checkpoint without a place here; a trailing dot: all below."""
    unused = ["aggregator.patch_embed.mask_token", "track_head."]
    return unused if config.point_head else [*unused, "point_head."]
