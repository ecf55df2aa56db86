"""Where a network computes, and in which numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from laser_slam.errors import ConfigError

CPU_FEATURES = Path("/proc/cpuinfo")
MEMORY = Path("/proc/meminfo")
CGROUP = Path("/sys/fs/cgroup")
# Files of a container's limit and of what it uses, and the line there, in both of their layouts.
CONTAINER = [
    ("memory.max", "memory.stat", "anon"),
    ("memory/memory.limit_in_bytes", "memory/memory.stat", "total_rss"),
]
NO_LIMIT = 1 << 62
FAST_BF16 = {"amx_bf16", "avx512_bf16"}  # without them, bfloat16 is slower than float32
HALF_CAPABILITY = (8, 0)  # of a CUDA device that computes bfloat16


@dataclass(frozen=True)
class Placement:
    """A device and the kind of numbers that all layers but the heads compute with.

    Attributes:
        device: of weights and activations.
        dtype: float32; bfloat16, in which weights are kept too; float16, whose range is too small
            for the sums between layers: weights stay float32 and layers cast.
    """

    device: torch.device
    dtype: torch.dtype

    @property
    def weights_dtype(self) -> torch.dtype:
        """Return the dtype of the weights of all layers but the heads."""
        return torch.float32 if self.dtype == torch.float16 else self.dtype

    @property
    def dtype_name(self) -> str:
        """Return the dtype as settings name it."""
        return str(self.dtype).removeprefix("torch.")

    def upload(self, images: NDArray[np.uint8]) -> Tensor:
        """Return (1, N, 3, H, W) float32 in [0, 1] on the device, of (N, H, W, 3) RGB.

        Bytes travel, a quarter of what floats would take; from pinned memory where that helps.
        """
        pixels = torch.from_numpy(images)
        if self.device.type == "cuda":
            pixels = pixels.pin_memory()
        moved = pixels.to(self.device, non_blocking=True)
        return (moved.permute(0, 3, 1, 2)[None] / 255).contiguous()

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Keep no gradients; cast to float16 where that is the dtype."""
        casts = self.dtype == torch.float16
        with (
            torch.inference_mode(),
            torch.autocast(self.device.type, self.dtype) if casts else nullcontext(),
        ):
            yield

    def free_bytes(self) -> int:
        """Return the memory that a network and its activations can still have."""
        if self.device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(self.device)
            held = torch.cuda.memory_reserved(self.device)
            return free + held - torch.cuda.memory_allocated(self.device)
        if self.device.type == "mps":
            return torch.mps.recommended_max_memory() - torch.mps.current_allocated_memory()
        return min(_free_of_machine(), _free_of_container())


def choose_placement(device: str, dtype: str, section: str) -> Placement:
    """Choose device and dtype by the settings ``<section>.device`` and ``<section>.dtype``.

    ``auto`` takes a CUDA device, else Apple's, else the CPU; on CUDA bfloat16, or float16 where
    the device is older; float32 on Apple's; on the CPU bfloat16 where it has instructions for it.

    Raises:
        ConfigError: there is no such device, or it does not compute with this dtype.
    """
    there = _devices()
    if device == "auto":
        chosen = torch.device(there[0])
    else:
        chosen = _parse(device, there, section)
    if dtype == "auto":
        return Placement(chosen, _fast_dtype(chosen))
    if dtype == "float16" and chosen.type == "cpu":
        raise ConfigError(
            f"{section}.dtype: a CPU is slow with float16; use auto, bfloat16 or float32"
        )
    if dtype == "float16" and not torch.amp.is_autocast_available(chosen.type):
        raise ConfigError(
            f"{section}.dtype: this PyTorch does not cast to float16 on '{chosen}'; use auto or "
            "float32, or install a newer PyTorch"
        )
    return Placement(
        chosen, {"float32": torch.float32, "bfloat16": torch.bfloat16}.get(dtype, torch.float16)
    )


def full_precision(tokens: Tensor) -> AbstractContextManager[object]:
    """Return a context without a surrounding autocast, for what half precision would spoil."""
    device = tokens.device.type
    if not torch.amp.is_autocast_available(device):
        return nullcontext()  # then nothing surrounds it either
    return torch.autocast(device, enabled=False)


def is_out_of_memory(error: RuntimeError) -> bool:
    """Tell whether PyTorch found no memory, which only CUDA says by the error's type."""
    text = str(error)
    return (
        isinstance(error, torch.cuda.OutOfMemoryError)
        or "out of memory" in text
        or "DefaultCPUAllocator" in text
    )


def is_overflow(error: RuntimeError) -> bool:
    """Tell whether a matrix could not be decomposed, as happens to numbers that are not finite."""
    return isinstance(error, torch.linalg.LinAlgError)  # type: ignore[attr-defined]


def _devices() -> list[str]:
    """Return all devices, the best first."""
    cuda = [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    if not torch.cuda.is_available():
        cuda = []
    return [*cuda, *(["mps"] if torch.backends.mps.is_available() else []), "cpu"]


def _parse(device: str, there: list[str], section: str) -> torch.device:
    name = "cuda:0" if device == "cuda" else device
    if name not in there:
        hint = "; PyTorch was installed without CUDA" if _wants_cuda(name) else ""
        raise ConfigError(
            f"{section}.device: no '{device}' here, there is {', '.join(there)}{hint}"
        )
    return torch.device(name)


def _wants_cuda(name: str) -> bool:
    return name.startswith("cuda") and torch.version.cuda is None and torch.version.hip is None


def _fast_dtype(device: torch.device) -> torch.dtype:
    if device.type == "cuda":
        is_new = torch.cuda.get_device_capability(device) >= HALF_CAPABILITY
        return torch.bfloat16 if is_new else torch.float16
    if device.type == "cpu" and FAST_BF16 & _cpu_features():
        return torch.bfloat16
    return torch.float32


def _cpu_features() -> set[str]:
    """Return the flags of the processor; empty where the system does not say."""
    try:
        lines = CPU_FEATURES.read_text().splitlines()
    except OSError:
        return set()
    flags = next((line for line in lines if line.startswith("flags")), "")
    return set(flags.partition(":")[2].split())


def _free_of_machine() -> int:
    try:
        lines = MEMORY.read_text().splitlines()
    except OSError:
        return 8 << 30  # what any machine with a network has
    free = next((line for line in lines if line.startswith("MemAvailable")), "MemAvailable: 0 kB")
    return int(free.split()[1]) << 10


def _free_of_container() -> int:
    """Return what is left of a container's limit, which the machine does not tell.

    Files that were read count for nothing: the system drops them when memory gets short.
    """
    for limit, stat, key in CONTAINER:
        try:
            most = int((CGROUP / limit).read_text())
            lines = (CGROUP / stat).read_text().splitlines()
        except (OSError, ValueError):  # there is no such file, or it says "max"
            continue
        used = next((int(line.split()[1]) for line in lines if line.startswith(f"{key} ")), 0)
        return max(most - used, 0)
    return NO_LIMIT
