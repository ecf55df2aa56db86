"""Parts of the dense heads against the original's, and what a textbook would get wrong."""

from __future__ import annotations

import golden
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.networks import dpt
from laser_slam.networks.dpt import (
    DenseHead,
    DptConfig,
    Fusion,
    Residual,
    add_positions,
    embed_positions,
    spread_cells,
)

FEATURES = 8
ASPECT = 70 / 56  # of the image whose positions were kept
FUSED = [("fusion_out_x2", (8, 10)), ("fusion_out_size_7_9", (7, 9))]


class TextbookResidual(Residual):
    """The unit as it is drawn: the connection passes on everything."""

    def forward(self, maps: Tensor) -> Tensor:
        out: Tensor = maps + self.conv2(functional.relu(self.conv1(functional.relu(maps))))
        return out


@torch.no_grad()
def fuse(size: tuple[int, int]) -> Tensor:
    fusion = Fusion(FEATURES)
    golden.fill(fusion, "fusion.")
    known = golden.load_functions()
    deep, skip = (torch.from_numpy(known[f"fusion_in_{name}"]) for name in ("deep", "skip"))
    out: Tensor = fusion(deep, skip, size)
    return out


@pytest.mark.parametrize(("name", "size"), FUSED)
def test_maps_are_fused_as_the_original_does(name: str, size: tuple[int, int]) -> None:
    assert golden.relative_difference(fuse(size), golden.load_functions()[name]) < 1e-6


@pytest.mark.parametrize(("name", "size"), FUSED)
def test_a_textbook_residual_would_be_wrong(
    monkeypatch: pytest.MonkeyPatch, name: str, size: tuple[int, int]
) -> None:
    monkeypatch.setattr(dpt, "Residual", TextbookResidual)
    assert golden.relative_difference(fuse(size), golden.load_functions()[name]) > 0.1


@torch.no_grad()
def test_what_is_negative_stays_behind_at_a_residual() -> None:
    residual = Residual(FEATURES)
    for parameter in residual.parameters():
        nn.init.zeros_(parameter)
    maps = torch.linspace(-1, 1, 4 * FEATURES).view(1, FEATURES, 2, 2)
    before = maps.clone()
    assert torch.equal(residual(maps), maps.clamp(min=0))
    assert torch.equal(maps, before)


def test_cells_lie_where_the_original_puts_them() -> None:
    expected = golden.load_functions()["uv_grid_w5_h4_aspect70_56"]
    y, x = spread_cells((4, 5), ASPECT)
    found = torch.stack([x.expand(4, -1), y[:, None].expand(-1, 5)], dim=-1)
    assert golden.relative_difference(found, expected) < 1e-6


@pytest.mark.parametrize("grid", [(4, 5), (1, 1), (11, 37)])
def test_cells_are_square_and_their_image_has_a_diagonal_of_two(grid: tuple[int, int]) -> None:
    rows, columns = grid
    y, x = spread_cells(grid, columns / rows)
    pitch = 2 / np.hypot(rows, columns)
    np.testing.assert_allclose(y, pitch * (np.arange(rows) - (rows - 1) / 2), atol=1e-12)
    np.testing.assert_allclose(x, pitch * (np.arange(columns) - (columns - 1) / 2), atol=1e-12)


def test_positions_are_waves_of_columns_then_of_rows() -> None:
    expected = golden.load_functions()["uv_embed_c16"]
    of_x, of_y = embed_positions(16, (4, 5), ASPECT)
    added = add_positions(torch.zeros(2, 16, 4, 5), ASPECT)
    assert golden.relative_difference(10 * added[1].permute(1, 2, 0), expected) < 1e-6
    np.testing.assert_allclose(of_x.T, expected[0, :, :8], atol=1e-6)
    np.testing.assert_allclose(of_y.T, expected[:, 0, 8:], atol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("size", [(14, 14), (28, 70), (154, 518)])
def test_maps_are_as_large_as_the_image(size: tuple[int, int]) -> None:
    head = DenseHead(16, 3, DptConfig((4, 4, 8, 8), FEATURES))
    golden.fill(head, "depth_head.")
    tokens = torch.randn(
        2, size[0] * size[1] // 196, 16, generator=torch.Generator().manual_seed(0)
    )
    maps = head([tokens, tokens, tokens, tokens.bfloat16()], size)
    assert maps.shape == (2, 3, *size)
    assert maps.dtype == torch.float32
    assert bool(maps.isfinite().all())
