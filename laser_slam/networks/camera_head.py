"""A camera for each frame of a window, refined in steps from one token a frame.

Reference: Wang et al., VGGT (arXiv:2503.11651). Modules carry the names of its released checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks.transformer import Block, BlockConfig

NORM_EPS = 1e-5
PLAIN_NORM_EPS = 1e-6  # of the norm that has no weights
SIZE = 9  # numbers of an encoded camera: translation 3, quaternion x y z w, angles of view 2
NUM_STEPS = 4  # as trained


@dataclass(frozen=True)
class CameraHeadConfig:
    """The shape of a camera head; the defaults are those of VGGT's released checkpoint.

    Attributes:
        depth: number of blocks, in which frames see one another.
        num_heads: of their attention.
    """

    depth: int = 4
    num_heads: int = 16


class Cameras(NamedTuple):
    """Where cameras are and how they project.

    Attributes:
        cam_from_world: (..., 4, 4) rigid.
        intrinsics: (..., 3, 3), px.
    """

    cam_from_world: Tensor
    intrinsics: Tensor


class CameraHead(nn.Module):
    """Guess all cameras, look at the guess, correct it; the same weights in every step."""

    def __init__(self, width: int, config: CameraHeadConfig) -> None:
        """Build a head for tokens of ``width`` channels."""
        super().__init__()
        shape = BlockConfig(width, config.num_heads, eps=NORM_EPS)
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, SIZE))
        self.embed_pose = nn.Linear(SIZE, width)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 3 * width))
        self.token_norm = nn.LayerNorm(width, eps=NORM_EPS)
        self.trunk = nn.Sequential(*(Block(shape) for _ in range(config.depth)))
        self.trunk_norm = nn.LayerNorm(width, eps=NORM_EPS)
        self.pose_branch = PoseBranch(width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return the encoded cameras after every step.

        Args:
            tokens: (B, N, D) of N frames' cameras, in any dtype.

        Returns:
            (NUM_STEPS, B, N, 9): see ``decode_cameras``; angles of view are not negative.
        """
        tokens = self.token_norm(tokens.to(self.token_norm.weight.dtype))
        guess = self.empty_pose_tokens.expand(*tokens.shape[:2], -1)
        steps = [guess := self._correct(guess, tokens, is_first=not i) for i in range(NUM_STEPS)]
        # A negative angle is reported as none, but the next step looks at it as it is.
        encoded = torch.stack(steps)
        return torch.cat([encoded[..., :-2], functional.relu(encoded[..., -2:])], dim=-1)

    def _correct(self, guess: Tensor, tokens: Tensor, *, is_first: bool) -> Tensor:
        """Return (B, N, 9) corrected cameras; the first guess is no camera to correct."""
        change: Tensor = self.pose_branch(self.trunk_norm(self.trunk(self._blend(guess, tokens))))
        return change if is_first else guess + change

    def _blend(self, guess: Tensor, tokens: Tensor) -> Tensor:
        """Return (B, N, D) tokens that know of the guess."""
        shift, scale, gate = self.poseLN_modulation(self.embed_pose(guess)).chunk(3, dim=-1)
        plain = functional.layer_norm(tokens, tokens.shape[-1:], eps=PLAIN_NORM_EPS)
        out: Tensor = tokens + gate * (plain * (1 + scale) + shift)
        return out


class PoseBranch(nn.Module):
    """Two layers that turn a token into a change of its camera."""

    def __init__(self, width: int) -> None:
        """Build it for tokens of ``width`` channels."""
        super().__init__()
        self.fc1 = nn.Linear(width, width // 2)
        self.fc2 = nn.Linear(width // 2, SIZE)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (..., 9) for (..., D)."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(tokens)))
        return out


def decode_cameras(encoded: Tensor, size: tuple[int, int]) -> Cameras:
    """Decode cameras for images of ``size`` (H, W), px.

    Args:
        encoded: (..., 9): translation and quaternion (x, y, z, w; of any length) of camera from
            world, angles of view from top to bottom and from left to right, radians.
        size: of the images.

    Returns:
        Cameras with the image's centre (W/2, H/2) as principal point; an angle of 0 gives an
        infinite focal length.
    """
    translation, quat_xyzw, angles = encoded[..., :3], encoded[..., 3:7], encoded[..., 7:]
    cam_from_world = encoded.new_zeros(*encoded.shape[:-1], 4, 4)
    cam_from_world[..., :3, :3] = rotation_matrices(quat_xyzw)
    cam_from_world[..., :3, 3] = translation
    cam_from_world[..., 3, 3] = 1
    half_y, half_x = size[0] / 2, size[1] / 2
    tangents = (angles / 2).tan()
    intrinsics = encoded.new_zeros(*encoded.shape[:-1], 3, 3)
    intrinsics[..., 0, 0] = half_x / tangents[..., 1]
    intrinsics[..., 1, 1] = half_y / tangents[..., 0]
    intrinsics[..., 0, 2] = half_x
    intrinsics[..., 1, 2] = half_y
    intrinsics[..., 2, 2] = 1
    return Cameras(cam_from_world, intrinsics)


def rotation_matrices(quat_xyzw: Tensor) -> Tensor:
    """Return (..., 3, 3) rotations of (..., 4) quaternions, whose length does not matter."""
    vector, real = quat_xyzw[..., :3], quat_xyzw[..., 3:, None]
    twice = 2 / (quat_xyzw * quat_xyzw).sum(-1)[..., None, None]
    squares = (vector * vector).sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    outer = vector[..., :, None] * vector[..., None, :]
    cross = torch.linalg.cross(eye.expand_as(outer), vector[..., None, :].expand_as(outer))
    # With vector v and real part w: I + 2 / |q|^2 (v v^T - |v|^2 I + w [v]x).
    out: Tensor = eye + twice * (outer - squares * eye + real * cross)
    return out
