"""How much memory a window takes: the formula against a count of every tensor, op by op."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import memory_table
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import laser_slam.backbones
from laser_slam.backbones import choose_window_size
from laser_slam.backbones.feedforward import window as window_module
from laser_slam.config import load_config
from laser_slam.networks import placement
from laser_slam.networks.memory import MARGIN, Request, advise
from laser_slam.networks.pi3 import Pi3, Pi3Config
from laser_slam.networks.pi3x import Pi3X, Pi3XConfig
from laser_slam.networks.trunk import keeps_full_precision
from laser_slam.networks.vggt import Vggt, VggtConfig

KITTI = (154, 518)
DOCUMENT = (Path(__file__).parents[1] / "docs" / "backbones.md").read_text().splitlines()


class Count(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Add up the tensors that are alive, in bytes; those of the network are not counted."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.now, self.peak = 0, 0
        weights = [*network.parameters(), *network.buffers()]
        self.alive = {id(w.untyped_storage()): weakref.ref(w.untyped_storage()) for w in weights}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                self.see(leaf.untyped_storage())
        return out

    def see(self, storage: Any) -> None:
        key, size = id(storage), storage.size()
        known = self.alive.get(key)
        if known is not None and known() is storage:
            return

        def forget(_: Any) -> None:
            self.now -= size
            self.alive.pop(key, None)

        self.alive[key] = weakref.ref(storage, forget)
        self.now += size
        self.peak = max(self.peak, self.now)


def full_size(asked: Request) -> nn.Module:
    """Return the network without memory for its weights."""
    with torch.device("meta"):
        made: dict[str, nn.Module] = {
            "pi3": Pi3(Pi3Config(), asked.chunk),
            "pi3x": Pi3X(Pi3XConfig(), asked.chunk),
            "vggt": Vggt(VggtConfig(chunk=asked.chunk)),
        }
    network = made[asked.network]
    for key, weight in network.named_parameters():
        is_head = not key.startswith("aggregator.")
        if not (is_head if asked.network == "vggt" else keeps_full_precision(key)):
            weight.data = weight.data.to(getattr(torch, asked.dtype))
    return network.requires_grad_(requires_grad=False).eval()


def counted(asked: Request, num_frames: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Run a network that computes nothing, and return the most that was alive."""
    network = full_size(asked)
    # Fused attention makes its result and no more; a device without numbers has no fused form.
    monkeypatch.setattr(
        functional, "scaled_dot_product_attention", lambda q, k, v: torch.empty_like(q)
    )
    with torch.inference_mode(), Count(network) as count:
        network(torch.empty(1, num_frames, 3, *asked.size, device="meta"))
    return int(count.peak)


@pytest.mark.parametrize(
    ("asked", "num_frames"),
    [
        (Request("pi3", KITTI, "bfloat16"), 20),  # blocks take the most
        (Request("pi3", (266, 392), "float32"), 8),  # the heads do
        (Request("pi3x", KITTI, "bfloat16"), 9),
        (Request("vggt", KITTI, "bfloat16"), 20),
        (Request("vggt", KITTI, "float32", chunk=1), 20),
    ],
)
def test_the_formula_is_what_the_network_allocates(
    asked: Request, num_frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = counted(asked, num_frames, monkeypatch)
    assert asked.window_bytes(num_frames) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("network", ["pi3", "pi3x", "vggt"])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_weights_are_counted(network: str, dtype: str) -> None:
    asked = Request(network, KITTI, dtype)
    found = sum(weight.numel() * weight.element_size() for weight in full_size(asked).parameters())
    assert asked.weights_bytes() == found


@pytest.mark.parametrize("network", ["pi3", "pi3x", "vggt"])
@pytest.mark.parametrize("free_gb", [3, 6, 12, 24])
def test_the_largest_window_fits_and_one_more_frame_does_not(network: str, free_gb: int) -> None:
    asked, free = Request(network, KITTI, "bfloat16"), free_gb * 10**9
    most = asked.largest_window(free)
    assert asked.weights_bytes() + MARGIN * asked.window_bytes(most) <= free or most == 0
    assert asked.weights_bytes() + MARGIN * asked.window_bytes(most + 1) > free
    assert asked.largest_window(free - asked.weights_bytes(), has_weights=True) == most


def test_nothing_fits_where_there_is_no_room_for_the_weights() -> None:
    assert Request("pi3", KITTI, "float32").largest_window(3 << 30) == 0


def test_float16_is_counted_as_the_float32_that_its_weights_are() -> None:
    half, whole = Request("pi3", KITTI, "float16"), Request("pi3", KITTI, "float32")
    assert half.weights_bytes() == whole.weights_bytes()


def test_advice_names_a_size_that_fits_and_a_side_that_does() -> None:
    asked = Request("vggt", KITTI, "bfloat16")
    text = advise(asked, 75, 1 << 30, "backbone.vggt")
    fits = asked.largest_window(1 << 30, has_weights=True)
    assert f"lower windows.size to {fits} (or auto), or lower backbone.vggt.side to" in text
    assert "windows.size" not in advise(asked, 4, 1 << 28, "backbone.vggt")


def test_the_documents_tables_are_those_of_the_formula(capsys: pytest.CaptureFixture[str]) -> None:
    memory_table.main()
    for line in capsys.readouterr().out.splitlines():
        assert line in DOCUMENT


# --- windows.size=auto -------------------------------------------------------------------------


def choose(free_gb: float, monkeypatch: pytest.MonkeyPatch, overlap: int = 5) -> int:
    monkeypatch.setattr(placement.Placement, "free_bytes", lambda _: int(free_gb * 1e9))
    config = load_config(
        assignments=["backbone.name=vggt", "backbone.vggt.dtype=bfloat16"]
    ).backbone
    return choose_window_size(config, (376, 1241), overlap)


def test_a_window_is_as_large_as_memory_allows_up_to_what_is_good(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    some = choose(4.2, monkeypatch)
    assert 8 < some < window_module.MOST_FRAMES
    assert some == Request("vggt", KITTI, "bfloat16").largest_window(int(4.2e9))
    assert choose(80, monkeypatch) == window_module.MOST_FRAMES
    assert not caplog.records


def test_a_window_adds_frames_to_the_one_before_even_where_memory_is_short(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert choose(1, monkeypatch, overlap=30) == 33
    assert "lower windows.overlap or backbone.vggt.side" in caplog.text


@pytest.mark.parametrize("name", ["classical", "simulated", "replay"])
def test_backbones_without_a_network_have_the_usual_window(name: str) -> None:
    config = load_config(assignments=[f"backbone.name={name}"]).backbone
    assert choose_window_size(config, (376, 1241), 5) == laser_slam.backbones.WINDOW_SIZE
    assert choose_window_size(config, (376, 1241), 30) == 33
