"""pi3x: as pi3, in approximate metres, and it may be told depths, intrinsics and poses.

Written from the description of the released checkpoint, whose names the modules carry; no paper of
its own exists. Reference: Wang et al., pi3 (arXiv:2507.13347).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from laser_slam.networks.conditioning import (
    Conditions,
    PoseInjection,
    depth_maps,
    make_camera_frames,
    mean_depths,
    ray_maps,
    relative_poses,
)
from laser_slam.networks.dinov2 import (
    LARGE_WITH_REGISTERS,
    NORMALISATION,
    Encoder,
    EncoderConfig,
    PatchEmbedding,
)
from laser_slam.networks.heads import points_on_rays
from laser_slam.networks.metric import MetricConfig, MetricDecoder
from laser_slam.networks.pi3 import Pi3Output
from laser_slam.networks.placement import full_precision
from laser_slam.networks.transformer import BlockConfig
from laser_slam.networks.trunk import (
    NUM_SPECIAL,
    QUERY_EPS,
    Hidden,
    Injection,
    Layout,
    Pi3Config,
    Trunk,
    keeps_full_precision,
)
from laser_slam.networks.upsampling import UpsamplingHead
from laser_slam.networks.weights import Checkpoint, load_weights

__all__ = ["RELEASED", "Conditions", "Pi3X", "Pi3XConfig", "Pi3XOutput", "load_pi3x"]

MAX_LOG_DEPTH = 15.0  # beyond it, a depth says nothing
NUM_TOLD = 2  # channels of depth maps (and where they are known) and of ray maps

OF_DEPTHS = replace(LARGE_WITH_REGISTERS, channels=NUM_TOLD)
METRIC = MetricConfig()
RELEASED = Checkpoint(
    setting="backbone.pi3x.weights",
    file="model.safetensors",
    url="https://huggingface.co/yyfz233/Pi3X",
    size="5.44 GB",
    licence="CC BY-NC 4.0",
    repo="yyfz233/Pi3X",
)


@dataclass(frozen=True)
class Pi3XConfig(Pi3Config):
    """The shape of the network; the defaults are those of the released checkpoint.

    Attributes:
        depth_encoder: of depth maps; as wide as the images'.
        channels: of the maps of each stage of a head.
        metric: decoder of the scale.
        injected_after: blocks of the decoder, by index, after which poses come in; odd ones.
        takes_conditions: else that part of the network, a quarter of it, is left out.
    """

    depth_encoder: EncoderConfig = OF_DEPTHS
    channels: tuple[int, ...] = (256, 128, 64)
    metric: MetricConfig = METRIC
    injected_after: tuple[int, ...] = (1, 9, 17, 25, 33)
    takes_conditions: bool = True


class Pi3XOutput(NamedTuple):
    """What the network says of B windows of N frames, in approximate metres.

    Attributes:
        local_points: (B, N, H, W, 3) float32 in camera axes; z is positive.
        confidence: (B, N, H, W) float32 logits.
        window_from_cam: (B, N, 4, 4) float32, rigid; the window's axes are no camera's.
        tokens: (B, N, D) float32 of each image alone: the mean of its encoded patches.
        metric: (B,) float32 by which points and translations were multiplied.
    """

    local_points: Tensor
    confidence: Tensor
    window_from_cam: Tensor
    tokens: Tensor
    metric: Tensor


class Pi3X(Trunk):
    """Metric points, confidence and poses of the frames of a window.

    Attributes:
        chunk: frames that the heads take at once, which bounds their memory and changes no value;
            None: all.
    """

    def __init__(self, config: Pi3XConfig, chunk: int | None = None) -> None:
        """Build the network; its weights are to be loaded."""
        super().__init__(config)
        width = config.encoder.width
        self.chunk = chunk
        self.injected_after = config.injected_after
        self.point_head = UpsamplingHead(width, (2, 1), config.channels)
        self.conf_head = UpsamplingHead(width, (1,), config.channels)
        self.metric_token = nn.Parameter(torch.zeros(1, 1, 2 * width))
        self.metric_decoder = MetricDecoder(2 * width, config.metric)
        self.metric_head = nn.Linear(config.metric.width, 1)
        self.takes_conditions = config.takes_conditions
        if config.takes_conditions:
            self._add_conditioning(config)

    def _add_conditioning(self, config: Pi3XConfig) -> None:
        width = config.encoder.width
        self.depth_encoder = Encoder(config.depth_encoder)
        self.depth_emb = nn.Parameter(torch.zeros(1, 1, width))
        self.ray_embed = PatchEmbedding(width, NUM_TOLD)
        block = BlockConfig(width, config.num_heads, query_eps=QUERY_EPS)
        self.pose_inject_blk = nn.ModuleList(PoseInjection(block) for _ in config.injected_after)

    def forward(self, images: Tensor, conditions: Conditions | None = None) -> Pi3XOutput:
        """Predict windows.

        Args:
            images: (B, N, 3, H, W) RGB in [0, 1]; H and W are multiples of 14.
            conditions: what is known beside them. The unit of depths and poses is not taken over:
                only their proportions are.

        Raises:
            ValueError: H or W is no multiple of 14, or the network was built without the part
                that takes conditions.
        """
        told = Conditions() if conditions is None else conditions
        if not self.takes_conditions and any(part is not None for part in told):
            raise ValueError("conditions for a network that was built with takes_conditions=False")
        layout = self.layout(images)
        patches = self.encode(images)
        tokens = patches.mean(dim=1, dtype=torch.float32)
        patches = self._add_maps(patches, told, images.shape[-2:])
        hidden = self.decode(patches, layout, self._injection(told, layout))
        metric = self._measure(hidden, layout)
        size = (images.shape[-2], images.shape[-1])
        chunks = [self._predict(part, layout, size) for part in hidden.chunks(self.chunk)]
        points, confidence, poses = (torch.cat(parts) for parts in zip(*chunks, strict=True))
        scales = metric.repeat_interleave(layout.num_frames)
        poses[:, :3, 3] *= scales[:, None]
        points *= scales[:, None, None, None]
        outputs = Pi3Output(*map(layout.of_frames, (points, confidence, poses, tokens)))
        return Pi3XOutput(*outputs, metric)

    def _add_maps(self, patches: Tensor, told: Conditions, size: tuple[int, ...]) -> Tensor:
        """Add what depths and rays say to (B N, P, D) tokens."""
        if told.depths is not None:
            depths = told.depths.float()
            maps = depth_maps(depths, mean_depths(depths))
            patches = patches + self.depth_encoder(maps).patches + self.depth_emb
        if told.intrinsics is not None:
            with full_precision(patches):
                maps = ray_maps(told.intrinsics, (size[0], size[1]))
            patches = patches + self.ray_embed(maps)
        return patches

    def _injection(self, told: Conditions, layout: Layout) -> Injection | None:
        """Return what adds poses to tokens inside the decoder; None: nothing is known of them."""
        if told.world_from_cam is None or layout.num_frames == 1:
            return None
        channels = self.config.encoder.width // self.config.num_heads
        with full_precision(told.world_from_cam):
            means = None if told.depths is None else mean_depths(told.depths.float())
            relative = relative_poses(told.world_from_cam, means)
            frames = make_camera_frames(relative, layout.grid, channels)

        def inject(index: int, tokens: Tensor) -> Tensor:
            if index not in self.injected_after:
                return tokens
            block = self.pose_inject_blk[self.injected_after.index(index)]
            special, patches = tokens[:, :NUM_SPECIAL], tokens[:, NUM_SPECIAL:]
            windows = layout.of_frames(patches).flatten(1, 2)
            added = block(windows, frames).view(patches.shape)
            return torch.cat([special, patches + added], dim=1)

        return inject

    def _measure(self, hidden: Hidden, layout: Layout) -> Tensor:
        """Return (B,) metric scales."""
        parts = [self.metric_decoder.projects_y(part) for part in hidden.chunks(self.chunk)]
        context = layout.of_frames(torch.cat(parts)).flatten(1, 2)
        positions = layout.positions.repeat(layout.num_frames, 1)
        answer = self.metric_decoder(self.metric_token, context, positions)
        with full_precision(answer):
            scales: Tensor = self.metric_head(answer.float()).exp()
        return scales[:, 0]

    def _predict(
        self, hidden: Tensor, layout: Layout, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return points, confidence and poses of F frames for (F, T, 2 D) tokens, not metric."""
        points = self.point_decoder(hidden, layout.rotation)[:, NUM_SPECIAL:]
        confidence = self.conf_decoder(hidden, layout.rotation)[:, NUM_SPECIAL:]
        with full_precision(hidden):
            raw = self.point_head(points.float(), layout.grid, size)
            logits = self.conf_head(confidence.float(), layout.grid, size)
            local_points = points_on_rays(raw[..., :2], raw[..., 2:].clamp(max=MAX_LOG_DEPTH))
        return local_points, logits[..., 0], self.locate(hidden, layout)


SHAPE = Pi3XConfig()  # of the released checkpoint
CONDITIONING = ("depth_encoder.", "depth_emb", "ray_embed.", "pose_inject_blk.")


def load_pi3x(path: str, dtype: torch.dtype = torch.float32, config: Pi3XConfig = SHAPE) -> Pi3X:
    """Build the network with the weights of a released or retrained checkpoint.

    The part that takes conditions is in the file whole, or the network is built without it: then
    it may be in the file or not.

    Args:
        path: of the file.
        dtype: of encoders and decoders; the heads stay in float32.
        config: the shape of the network that the file is of.

    Raises:
        WeightsError: the file is not there, cannot be read or is of another network.
    """
    with torch.device("meta"):  # takes no memory and no time
        network = Pi3X(config)
    load_weights(
        network,
        path,
        RELEASED,
        unused=() if config.takes_conditions else CONDITIONING,
        constants=NORMALISATION,
        dtype=lambda key: torch.float32 if keeps_full_precision(key) else dtype,
    )
    return network.requires_grad_(requires_grad=False).eval()
