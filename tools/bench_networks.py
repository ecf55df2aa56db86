"""Time and memory of a network on one window, with drawn weights: no checkpoint is needed.

    python tools/bench_networks.py --network pi3 --frames 20 --dtype bfloat16
    python tools/bench_networks.py --network vggt --frames 5 --frames 20 --size 924x266 --chunk 4
    python tools/bench_networks.py --network pi3 --load /tmp/model.safetensors

One row per number of frames, in the order given: seconds on the wall and of the processor, the
weights' memory, and the peak of all memory (of the process on a CPU, of PyTorch's own on a GPU).
With --load the drawn weights are written to that file, read back as a user's would be, timed, and
the file is removed.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import typer
from safetensors.torch import save_file
from torch import Tensor, nn

from laser_slam.networks.pi3 import Pi3, Pi3Config, load_pi3
from laser_slam.networks.pi3x import Pi3X, Pi3XConfig, load_pi3x
from laser_slam.networks.trunk import keeps_full_precision
from laser_slam.networks.vggt import Vggt, VggtConfig, load_vggt

GIB = 2**30
SELF = Path("/proc/self")


class Kind(NamedTuple):
    """How a network is built for a number of frames that its heads take at once, and loaded."""

    build: Callable[[int | None], nn.Module]
    load: Callable[[str, torch.dtype], nn.Module]


NETWORKS = {
    "pi3": Kind(lambda chunk: Pi3(Pi3Config(), chunk), load_pi3),
    "pi3x": Kind(lambda chunk: Pi3X(Pi3XConfig(), chunk), load_pi3x),
    "vggt": Kind(lambda chunk: Vggt(VggtConfig(chunk=chunk)), load_vggt),
}
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def draw_network(kind: Kind, chunk: int | None, dtype: torch.dtype, device: str) -> nn.Module:
    """Build a network whose activations stay of order one; heads stay in float32."""
    with torch.device("meta"):
        network = kind.build(chunk)
    for name, part in list(network.named_children()):
        part.to(torch.float32 if keeps_full_precision(name) else dtype)
    for name, parameter in list(network.named_parameters(recurse=False)):
        setattr(network, name, nn.Parameter(parameter.to(dtype)))
    network.to_empty(device=device)
    torch.manual_seed(0)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            _draw(name, parameter)
    return network.requires_grad_(requires_grad=False).eval()


def _draw(name: str, parameter: Tensor) -> None:
    if parameter.ndim > 1:
        half_width = math.sqrt(3 / math.prod(parameter.shape[1:]))
        parameter.uniform_(-half_width, half_width)
    elif name.endswith("gamma"):
        parameter.fill_(0.01)
    else:
        parameter.fill_(0.0 if name.endswith("bias") else 1.0)


class Row(NamedTuple):
    """What one window took."""

    frames: int
    wall_s: float
    cpu_s: float
    peak_gib: float


def time_window(network: nn.Module, frames: int, size: tuple[int, int], device: str) -> Row:
    """Predict a window of (height, width) frames and say what it took."""
    images = torch.rand(1, frames, 3, *size, device=device)
    is_cuda = torch.device(device).type == "cuda"
    if is_cuda:
        _predict(network, images)  # the first call loads and chooses kernels
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    else:
        _reset_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    _predict(network, images)
    if is_cuda:
        torch.cuda.synchronize()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = torch.cuda.max_memory_allocated() if is_cuda else _read_status("VmHWM")
    return Row(frames, wall, cpu, peak / GIB)


@torch.inference_mode()
def _predict(network: nn.Module, images: Tensor) -> Any:
    return network(images)


def _read_status(field: str) -> int:
    """Return bytes that Linux reports of this process; 0 elsewhere."""
    status = SELF / "status"
    text = status.read_text() if status.exists() else ""
    match = re.search(rf"{field}:\s+(\d+) kB", text)
    return 1024 * int(match[1]) if match else 0


def _reset_peak() -> None:
    clear = SELF / "clear_refs"
    if clear.exists():
        clear.write_text("5")


def time_loading(kind: Kind, file: Path, dtype: torch.dtype) -> str:
    """Write the float32 weights of a network, load them back and say what it took."""
    save_file(draw_network(kind, None, torch.float32, "cpu").state_dict(), file)
    size_gb = file.stat().st_size / 1e9
    _reset_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    loaded = kind.load(str(file), dtype)
    with torch.no_grad():
        touched = sum(float(parameter.sum()) for parameter in loaded.parameters())
    took = time.perf_counter() - wall, time.process_time() - cpu
    file.unlink()
    peak = _read_status("VmHWM") / GIB
    is_finite = "" if math.isfinite(touched) else " (not finite)"
    return (
        f"{size_gb:.2f} GB loaded and read through in {took[0]:.1f} s ({took[1]:.1f} s of "
        f"processor), peak {peak:.2f} GiB{is_finite}"
    )


def main(  # noqa: PLR0913, PLR0917  (the options of a command)
    network: Annotated[str, typer.Option(help=", ".join(NETWORKS))] = "pi3",
    frames: Annotated[
        list[int] | None, typer.Option(help="of a window; 5 and 20 if not given")
    ] = None,
    dtype: Annotated[str, typer.Option(help=", ".join(DTYPES))] = "float32",
    size: Annotated[str, typer.Option(help="width x height, px, multiples of 14")] = "518x154",
    chunk: Annotated[int, typer.Option(help="frames that heads take at once; 0: all")] = 8,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1, ...")] = "cpu",
    load: Annotated[Path | None, typer.Option(help="file to be written, loaded, removed")] = None,
) -> None:
    """Print one row of time and memory per number of frames, or what loading takes."""
    kind, kept = NETWORKS[network], DTYPES[dtype]
    width, height = (int(side) for side in size.split("x"))
    if load is not None:
        print(f"{network} {dtype}: {time_loading(kind, load, kept)}")
        return
    drawn = draw_network(kind, chunk or None, kept, device)
    weights = sum(p.numel() * p.element_size() for p in drawn.parameters()) / GIB
    print("network  dtype     size     frames  wall s   cpu s  frames/s  weights GiB  peak GiB")
    for count in frames or [5, 20]:
        row = time_window(drawn, count, (height, width), device)
        print(
            f"{network:8} {dtype:9} {size:9} {row.frames:5} {row.wall_s:7.2f} {row.cpu_s:7.1f} "
            f"{row.frames / row.wall_s:9.3f} {weights:12.2f} {row.peak_gib:9.2f}",
            flush=True,
        )


if __name__ == "__main__":
    typer.run(main)
