"""The transformer block that encoders, decoders and heads share; options say how they differ."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.rope import Rotation, rotate


@dataclass(frozen=True)
class BlockConfig:
    """The shape of a block; keys of checkpoints are the same with every option.

    Attributes:
        width: channels D of a token.
        num_heads: of the attention; they share the width.
        eps: of the two norms.
        query_eps: of norms of queries and keys, per head; None: they are not normed.
        is_scaled: the residual branches have learnt factors.
    """

    width: int
    num_heads: int
    eps: float = 1e-6
    query_eps: float | None = None
    is_scaled: bool = True


class Block(nn.Module):
    """Attention, then a two-layer perceptron; each adds its result to the tokens."""

    def __init__(self, config: BlockConfig) -> None:
        """Build a block; its weights are to be loaded."""
        super().__init__()
        self.norm1 = nn.LayerNorm(config.width, eps=config.eps)
        self.attn = Attention(config)
        self.ls1 = make_scale(config)
        self.norm2 = nn.LayerNorm(config.width, eps=config.eps)
        self.mlp = Perceptron(config.width)
        self.ls2 = make_scale(config)

    def forward(self, tokens: Tensor, rotation: Rotation | None = None) -> Tensor:
        """Return (B, T, D) tokens for (B, T, D); those of one batch entry see one another.

        Args:
            tokens: of a frame each, or (B, N T', D) of all frames for global attention.
            rotation: for the T positions, of D / num_heads channels; None: positions don't matter.
        """
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens), rotation))
        out: Tensor = tokens + self.ls2(self.mlp(self.norm2(tokens)))
        return out


class Attention(nn.Module):
    """Attention of all tokens to one another, in fused form."""

    def __init__(self, config: BlockConfig) -> None:
        """Build it for tokens whose channels the heads share."""
        super().__init__()
        self.num_heads = config.num_heads
        self.qkv = nn.Linear(config.width, 3 * config.width)
        self.proj = nn.Linear(config.width, config.width)
        self.q_norm = _make_query_norm(config)
        self.k_norm = _make_query_norm(config)

    def forward(self, tokens: Tensor, rotation: Rotation | None = None) -> Tensor:
        """Return (B, T, D) for (B, T, D)."""
        query, key, value = self.heads(tokens)
        if rotation is not None:
            query, key = rotate(query, rotation), rotate(key, rotation)
        return self.mix(query, key, value)

    def heads(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return normed queries and keys, and values, (B, heads, T, D / heads) each."""
        split = self.qkv(tokens).unflatten(-1, (3, self.num_heads, -1))
        query, key, value = split.permute(2, 0, 3, 1, 4)
        # Under autocast the norms may answer in float32, in which attention has no fused form.
        return self.q_norm(query).to(value.dtype), self.k_norm(key).to(value.dtype), value

    def mix(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend, and return (B, T, D)."""
        mixed = functional.scaled_dot_product_attention(query, key, value)
        return self.join(mixed)

    def join(self, mixed: Tensor) -> Tensor:
        """Return (B, T, D) of the heads' (B, heads, T, D / heads)."""
        out: Tensor = self.proj(mixed.transpose(1, 2).flatten(2))
        return out


class Perceptron(nn.Module):
    """Two layers, four times as wide between them."""

    def __init__(self, width: int) -> None:
        """Build it for tokens of ``width`` channels."""
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, T, D) for (B, T, D)."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(tokens)))
        return out


class LayerScale(nn.Module):
    """A learnt factor for each channel."""

    def __init__(self, width: int) -> None:
        """Start from zero: the factors are to be loaded."""
        super().__init__()
        self.gamma = nn.Parameter(torch.zeros(width))

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (..., D) for (..., D)."""
        return tokens * self.gamma


def make_scale(config: BlockConfig) -> nn.Module:
    """Return the factors of a residual branch, or what leaves it alone."""
    return LayerScale(config.width) if config.is_scaled else nn.Identity()


def _make_query_norm(config: BlockConfig) -> nn.Module:
    if config.query_eps is None:
        return nn.Identity()
    return nn.LayerNorm(config.width // config.num_heads, eps=config.query_eps)
