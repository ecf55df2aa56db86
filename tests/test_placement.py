"""Where networks compute and in which numbers; none of it needs the device that it is about."""

from pathlib import Path

import numpy as np
import pytest
import torch

from laser_slam.errors import ConfigError
from laser_slam.networks import placement
from laser_slam.networks.placement import (
    Placement,
    choose_placement,
    full_precision,
    is_out_of_memory,
)

CPU = Placement(torch.device("cpu"), torch.float32)


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Pretend a CPU without features, and no other device."""
    flags = tmp_path / "cpuinfo"
    flags.write_text("processor : 0\nflags\t\t: fpu avx2 avx512f\n")
    monkeypatch.setattr(placement, "CPU_FEATURES", flags)
    have_cuda(monkeypatch, 0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    return flags


def have_cuda(
    monkeypatch: pytest.MonkeyPatch, count: int, capability: tuple[int, int] = (8, 0)
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)


def chosen(device: str = "auto", dtype: str = "auto") -> tuple[str, str]:
    found = choose_placement(device, dtype, "backbone.pi3")
    return str(found.device), found.dtype_name


@pytest.mark.parametrize(
    ("capability", "dtype"), [((7, 5), "float16"), ((8, 0), "bfloat16"), ((9, 0), "bfloat16")]
)
def test_a_gpu_is_taken_first_with_what_it_computes_fast(
    monkeypatch: pytest.MonkeyPatch, plain: Path, capability: tuple[int, int], dtype: str
) -> None:
    have_cuda(monkeypatch, 2, capability)
    assert chosen() == ("cuda:0", dtype)
    assert chosen("cuda") == ("cuda:0", dtype)
    assert chosen("cuda:1") == ("cuda:1", dtype)
    assert chosen("cpu") == ("cpu", "float32")
    assert chosen("auto", "float32") == ("cuda:0", "float32")


def test_apples_gpu_computes_in_float32(monkeypatch: pytest.MonkeyPatch, plain: Path) -> None:
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert chosen() == ("mps", "float32")
    assert chosen("auto", "float16") == ("mps", "float16")


def test_where_pytorch_cannot_cast_nothing_is_cast(
    monkeypatch: pytest.MonkeyPatch, plain: Path
) -> None:
    """As older ones cannot on Apple's GPUs: float32 is computed, float16 refused."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("User specified an unsupported autocast device_type 'mps'")

    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.amp, "is_autocast_available", lambda device: device == "cpu")
    monkeypatch.setattr(torch, "autocast", refuse)
    tokens = torch.ones(2, device="meta")
    with Placement(torch.device("mps"), torch.float32).computing(), full_precision(tokens):
        assert tokens.add(1).dtype == torch.float32
    assert chosen() == ("mps", "float32")
    with pytest.raises(ConfigError, match=r"pi3\.dtype: .* does not cast to float16 on 'mps'; use"):
        chosen("auto", "float16")


@pytest.mark.parametrize("feature", ["amx_bf16", "avx512_bf16"])
def test_a_cpu_computes_in_bfloat16_only_where_it_has_instructions_for_it(
    plain: Path, feature: str
) -> None:
    assert chosen() == ("cpu", "float32")
    assert chosen("cpu", "bfloat16") == ("cpu", "bfloat16")
    plain.write_text(f"flags : fpu {feature} avx2\n")
    assert chosen() == ("cpu", "bfloat16")
    plain.unlink()  # not every system says
    assert chosen() == ("cpu", "float32")


@pytest.mark.parametrize("device", ["cuda", "cuda:3", "mps", "tpu"])
def test_a_device_that_is_not_there_is_one_line(plain: Path, device: str) -> None:
    with pytest.raises(ConfigError) as caught:
        chosen(device)
    expected = f"backbone.pi3.device: no '{device}' here, there is cpu"
    assert str(caught.value).startswith(expected)
    if torch.version.cuda is None:
        assert str(caught.value).endswith("without CUDA") == device.startswith("cuda")


def test_a_cpu_refuses_float16(plain: Path) -> None:
    with pytest.raises(ConfigError, match=r"backbone\.pi3\.dtype: a CPU is slow with float16; use"):
        chosen("cpu", "float16")


def test_weights_stay_wide_where_half_the_range_is_too_small() -> None:
    """Sums between layers leave the range of float16; bfloat16 has that of float32."""
    cuda = torch.device("cuda")
    assert Placement(cuda, torch.float16).weights_dtype == torch.float32
    assert Placement(cuda, torch.bfloat16).weights_dtype == torch.bfloat16
    assert CPU.weights_dtype == torch.float32


def test_layers_compute_in_float16_from_wide_weights() -> None:
    layer = torch.nn.Linear(4, 4)
    with Placement(torch.device("cpu"), torch.float16).computing():
        out = layer(torch.ones(1, 4))
        assert out.dtype == torch.float16
        assert torch.is_inference(out)
    with CPU.computing():
        assert layer(torch.ones(1, 4)).dtype == torch.float32


def test_images_arrive_as_planes_between_0_and_1() -> None:
    images = np.random.default_rng(0).integers(0, 256, (3, 14, 28, 3), dtype=np.uint8)
    uploaded = CPU.upload(images)
    assert uploaded.dtype == torch.float32
    assert uploaded.shape == (1, 3, 3, 14, 28)
    np.testing.assert_array_equal(
        uploaded[0].numpy(), images.transpose(0, 3, 1, 2).astype(np.float32) / 255
    )


def test_images_go_to_a_gpu_from_pinned_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """From any other, the copy would wait for the GPU, and the GPU for it."""
    pinned: list[torch.Tensor] = []
    moved: list[tuple[torch.Tensor, bool]] = []

    def pin(pixels: torch.Tensor) -> torch.Tensor:
        pinned.append(pixels.clone())
        return pinned[-1]

    def move(pixels: torch.Tensor, device: torch.device, non_blocking: bool) -> torch.Tensor:
        assert device.type == "cuda"
        moved.append((pixels, non_blocking))
        return pixels

    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    monkeypatch.setattr(torch.Tensor, "to", move)
    Placement(torch.device("cuda"), torch.bfloat16).upload(np.zeros((3, 14, 28, 3), np.uint8))
    ((pixels, does_not_wait),) = moved
    assert pixels is pinned[0]
    assert pixels.dtype == torch.uint8
    assert does_not_wait


def test_free_memory_is_the_machines_or_what_is_left_of_a_containers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    memory = tmp_path / "meminfo"
    memory.write_text("MemTotal: 9000 kB\nMemAvailable: 4000 kB\n")
    monkeypatch.setattr(placement, "MEMORY", memory)
    monkeypatch.setattr(placement, "CGROUP", tmp_path)
    assert CPU.free_bytes() == 4000 << 10
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.stat").write_text("anon 1000000\nfile 2000000\n")
    assert CPU.free_bytes() == 4000 << 10
    (tmp_path / "memory.max").write_text("3000000\n")
    assert CPU.free_bytes() == 2_000_000
    (tmp_path / "memory.max").unlink()
    (tmp_path / "memory").mkdir()
    (tmp_path / "memory/memory.limit_in_bytes").write_text("3000000\n")
    (tmp_path / "memory/memory.stat").write_text("cache 5\ntotal_rss 500000\n")
    assert CPU.free_bytes() == 2_500_000


def test_a_gpus_free_memory_counts_what_pytorch_holds_and_does_not_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (100, 900))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 50)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 30)
    assert Placement(torch.device("cuda:0"), torch.bfloat16).free_bytes() == 120


def test_lack_of_memory_is_told_from_other_errors() -> None:
    assert is_out_of_memory(torch.cuda.OutOfMemoryError("any text"))
    assert is_out_of_memory(RuntimeError("MPS backend out of memory (MPS allocated: 9 GB)"))
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60)
    assert is_out_of_memory(caught.value)
    assert not is_out_of_memory(RuntimeError("shapes cannot be multiplied"))
