"""The metric scale of a window in pi3x: one learnt question to all of its tokens."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.rope import Rotation, make_rotation, rotate
from laser_slam.networks.transformer import Perceptron

NORM_EPS = 1e-6


@dataclass(frozen=True)
class MetricConfig:
    """The shape of the decoder; the defaults are those of the released checkpoint.

    Attributes:
        width: channels.
        num_heads: of the attention; they share the width.
        depth: number of blocks.
    """

    width: int = 512
    num_heads: int = 8
    depth: int = 5


class MetricDecoder(nn.Module):
    """Blocks in which one token sees all tokens of a window, which stay as they are."""

    def __init__(self, width_in: int, config: MetricConfig) -> None:
        """Build it for tokens of ``width_in`` channels."""
        super().__init__()
        self.channels = config.width // config.num_heads
        self.projects_x = nn.Linear(width_in, config.width)
        self.projects_y = nn.Linear(width_in, config.width)
        self.blocks = nn.ModuleList(_CrossBlock(config) for _ in range(config.depth))
        self.linear_out = nn.Linear(config.width, config.width)

    def forward(self, question: Tensor, context: Tensor, positions: Tensor) -> Tensor:
        """Return the (B, width) answer.

        Args:
            question: (1, 1, width_in), the token at the origin of positions.
            context: (B, T, width) tokens of all frames, which ``projects_y`` made.
            positions: (T, 2) of the context.
        """
        rotation = make_rotation(positions, self.channels)
        answer = self.projects_x(question).expand(len(context), -1, -1)
        for block in self.blocks:
            answer = block(answer, context, rotation)
        out: Tensor = self.linear_out(answer)[:, 0]
        return out


class _CrossBlock(nn.Module):
    """Attention to other tokens, then a perceptron."""

    def __init__(self, config: MetricConfig) -> None:
        super().__init__()
        self.norm2 = nn.LayerNorm(config.width, eps=NORM_EPS)
        self.norm_y = nn.LayerNorm(config.width, eps=NORM_EPS)
        self.cross_attn = _CrossAttention(config)
        self.norm3 = nn.LayerNorm(config.width, eps=NORM_EPS)
        self.mlp = Perceptron(config.width)

    def forward(self, answer: Tensor, context: Tensor, rotation: Rotation) -> Tensor:
        answer = answer + self.cross_attn(self.norm2(answer), self.norm_y(context), rotation)
        out: Tensor = answer + self.mlp(self.norm3(answer))
        return out


class _CrossAttention(nn.Module):
    """Attention of a token at the origin to others; the origin does not turn it."""

    def __init__(self, config: MetricConfig) -> None:
        super().__init__()
        self.num_heads = config.num_heads
        self.q_proj, self.k_proj, self.v_proj, self.proj = (
            nn.Linear(config.width, config.width) for _ in range(4)
        )

    def forward(self, answer: Tensor, context: Tensor, rotation: Rotation) -> Tensor:
        query, value = self._split(self.q_proj(answer)), self._split(self.v_proj(context))
        key = rotate(self._split(self.k_proj(context)), rotation)
        mixed = functional.scaled_dot_product_attention(query, key, value)
        out: Tensor = self.proj(mixed.transpose(1, 2).flatten(2))
        return out

    def _split(self, tokens: Tensor) -> Tensor:
        return tokens.view(*tokens.shape[:-1], self.num_heads, -1).transpose(1, 2)
