"""Rotary positions against the original's, and the laws that attention relies on."""

from __future__ import annotations

import golden
import numpy as np
import pytest
import torch
from torch import Tensor

from laser_slam.networks.rope import grid_positions, make_rotation, rotate

CHANNELS = 32


def random_heads(seed: int, num_tokens: int = 12) -> Tensor:
    return torch.randn(2, 3, num_tokens, CHANNELS, generator=torch.Generator().manual_seed(seed))


def test_channels_turn_as_the_originals_do() -> None:
    known = golden.load_functions()
    heads = torch.from_numpy(known["rope_in"])
    for image, positions, expected in zip(
        heads, known["rope_positions_y_x"], known["rope_out"], strict=True
    ):
        rotation = make_rotation(torch.from_numpy(positions), heads.shape[-1])
        assert golden.relative_difference(rotate(image, rotation), expected) < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_products_of_queries_and_keys_know_differences_of_positions_only(seed: int) -> None:
    query, key = random_heads(2 * seed), random_heads(2 * seed + 1)
    positions = grid_positions(3, 4)
    shift = torch.tensor([5.0, -2.0])
    here, there = (make_rotation(p, CHANNELS) for p in (positions, positions + shift))
    expected = rotate(query, here) @ rotate(key, here).transpose(-1, -2)
    found = rotate(query, there) @ rotate(key, there).transpose(-1, -2)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(found, query @ key.transpose(-1, -2), atol=0.1)


def test_negative_positions_undo_a_rotation() -> None:
    heads, positions = random_heads(0), grid_positions(3, 4)
    turned = rotate(heads, make_rotation(positions, CHANNELS))
    torch.testing.assert_close(rotate(turned, make_rotation(-positions, CHANNELS)), heads)
    torch.testing.assert_close(turned.norm(dim=-1), heads.norm(dim=-1))


def test_special_tokens_stand_at_the_origin_and_do_not_turn() -> None:
    positions = grid_positions(2, 5, num_special=2)
    assert positions[:3].tolist() == [[0, 0], [0, 0], [1, 1]]
    assert positions[-1].tolist() == [2, 5]
    heads = random_heads(0)
    turned = rotate(heads, make_rotation(positions, CHANNELS))
    assert torch.equal(turned[:, :, :2], heads[:, :, :2])
    assert (turned[:, :, 2:] != heads[:, :, 2:]).any(dim=-1).all()


def test_frames_share_their_positions() -> None:
    rotation = make_rotation(grid_positions(3, 2), CHANNELS)
    frames = random_heads(1)
    apart = torch.cat([rotate(frames[:, :, i : i + 6], rotation) for i in (0, 6)], dim=2)
    assert torch.equal(rotate(frames, rotation.repeat(2)), apart)


def test_the_kind_of_number_stays() -> None:
    heads = random_heads(0).to(torch.bfloat16)
    rotation = make_rotation(grid_positions(3, 4), CHANNELS)
    turned = rotate(heads, rotation)
    assert turned.dtype == torch.bfloat16
    error = (turned.float() - rotate(heads.float(), rotation)).abs().mean() / heads.abs().mean()
    assert 1e-5 < float(error) < 0.01


def test_rows_come_before_columns() -> None:
    rotation = make_rotation(torch.tensor([[1.0, 0.0]]), CHANNELS)
    moved = np.flatnonzero(rotation.sin[0].numpy())
    assert moved.tolist() == list(range(CHANNELS // 2))
