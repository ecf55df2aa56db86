"""What pi3 and pi3x share: an encoder for each image, then blocks within frames and across them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from laser_slam.networks.dinov2 import LARGE_WITH_REGISTERS, PATCH, Encoder, EncoderConfig, Tokens
from laser_slam.networks.heads import HeadDecoder, PoseHead
from laser_slam.networks.placement import full_precision
from laser_slam.networks.rope import Rotation, grid_positions, make_rotation
from laser_slam.networks.transformer import Block, BlockConfig

NUM_SPECIAL = 5  # learnt tokens of a frame, before those of its patches
QUERY_EPS = 1e-5  # of the norms of queries and keys; all other norms have 1e-6

Injection: TypeAlias = Callable[[int, Tensor], Tensor]


@dataclass(frozen=True)
class Pi3Config:
    """The shape of the network; the defaults are those of the released checkpoint.

    Attributes:
        encoder: of the images; its width is the decoder's too.
        depth: blocks of the decoder, in turn within frames and across them; even.
        num_heads: of the decoder's attention, and of the head decoders'.
        head_depth: blocks of each head's decoder.
        camera_width: channels of the camera head.
    """

    encoder: EncoderConfig = LARGE_WITH_REGISTERS
    depth: int = 36
    num_heads: int = 16
    head_depth: int = 5
    camera_width: int = 512


class Layout(NamedTuple):
    """How the tokens of a batch of windows are ordered.

    Attributes:
        num_frames: N of a window.
        grid: rows and columns of a frame's patches.
        positions: (T, 2) of the T = 5 + rows columns tokens of a frame.
        rotation: for these positions, in the decoder and the heads' decoders.
    """

    num_frames: int
    grid: tuple[int, int]
    positions: Tensor
    rotation: Rotation

    def of_frames(self, tokens: Tensor) -> Tensor:
        """Return (B, N, ...) for (B N, ...)."""
        return tokens.view(-1, self.num_frames, *tokens.shape[1:])


class Hidden(NamedTuple):
    """Tokens of all frames after the decoder's last two blocks.

    The heads see both side by side, put together for as many frames at once as they take.

    Attributes:
        within: (B N, T, D) after the last block within frames.
        across: (B N, T, D) after the last block across frames.
    """

    within: Tensor
    across: Tensor

    def chunks(self, chunk: int | None) -> Iterator[Tensor]:
        """Yield (chunk, T, 2 D) tokens, frame after frame; None: all at once."""
        size = chunk or len(self.within)
        for pair in zip(*(torch.split(half, size) for half in self), strict=True):
            yield torch.cat(pair, dim=-1)


class Trunk(nn.Module):
    """Images to tokens that know all frames, and the heads' decoders.

    No frame is the first: the order of frames changes the order of the outputs only.
    """

    def __init__(self, config: Pi3Config) -> None:
        """Build the network; its weights are to be loaded."""
        super().__init__()
        width = config.encoder.width
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.register_token = nn.Parameter(torch.zeros(1, 1, NUM_SPECIAL, width))
        block = BlockConfig(width, config.num_heads, query_eps=QUERY_EPS)
        self.decoder = nn.ModuleList(Block(block) for _ in range(config.depth))
        self.point_decoder = self._make_decoder(width)
        self.conf_decoder = self._make_decoder(width)
        self.camera_decoder = self._make_decoder(config.camera_width)
        self.camera_head = PoseHead(config.camera_width)

    def _make_decoder(self, width_out: int) -> HeadDecoder:
        width = self.config.encoder.width
        block = BlockConfig(width, self.config.num_heads, is_scaled=False)
        return HeadDecoder(2 * width, width_out, self.config.head_depth, block)

    def layout(self, images: Tensor) -> Layout:
        """Return how tokens of (B, N, 3, H, W) images are ordered."""
        grid = images.shape[-2] // PATCH, images.shape[-1] // PATCH
        positions = grid_positions(*grid, NUM_SPECIAL, device=images.device)
        channels = self.config.encoder.width // self.config.num_heads
        return Layout(images.shape[1], grid, positions, make_rotation(positions, channels))

    def encode(self, images: Tensor) -> Tensor:
        """Return (B N, P, D) normalised patch tokens of (B, N, 3, H, W) images.

        Raises:
            ValueError: H or W is no multiple of ``PATCH``.
        """
        encoded: Tokens = self.encoder(images.flatten(0, 1))
        return encoded.patches

    def decode(self, patches: Tensor, layout: Layout, inject: Injection | None = None) -> Hidden:
        """Let tokens see those of their frame, then those of all frames, and so on in turn.

        Args:
            patches: (B N, P, D) tokens.
            layout: of the frames.
            inject: changes the (B N, T, D) tokens after the block of an index; None: nothing does.
        """
        special = self.register_token[0].expand(len(patches), -1, -1).to(patches)
        across = torch.cat([special, patches], dim=1)
        rotation = layout.rotation.repeat(layout.num_frames)
        for i in range(0, len(self.decoder), 2):
            within = self.decoder[i](across, layout.rotation)
            windows = layout.of_frames(within).flatten(1, 2)
            across = self.decoder[i + 1](windows, rotation).view(within.shape)
            if inject is not None:
                across = inject(i + 1, across)
        return Hidden(within, across)

    def locate(self, hidden: Tensor, layout: Layout) -> Tensor:
        """Return (F, 4, 4) float32 poses, window from camera, for (F, T, 2 D) tokens."""
        tokens = self.camera_decoder(hidden, layout.rotation)[:, NUM_SPECIAL:]
        with full_precision(tokens):
            poses: Tensor = self.camera_head(tokens.float())
        return poses


def keeps_full_precision(key: str) -> bool:
    """Say whether a weight stays in float32, whatever the others are in: those of the heads."""
    return key.partition(".")[0].endswith("_head")
