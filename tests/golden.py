"""Weights and images drawn from names alone, and what the original networks make of them.

A weight is a function of its name and shape: raw bits of PCG64, seeded with the name's crc32; four
16-bit parts of each word are summed (bell-shaped), scaled to unit variance and to what keeps
activations of order one. Streams into layer norms stay near 0.03, so that a wrong epsilon shows.
The values are the same on every machine; ``fingerprints`` of the manifests say so.
"""

import json
import math
import os
import re
import zlib
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

Array = NDArray[np.float32]

DATA = Path(__file__).parent / "data" / "golden"
EVERY_TAP = os.environ.get("LASER_SLAM_GOLDEN", "")
needs_every_tap = pytest.mark.skipif(
    not EVERY_TAP, reason="LASER_SLAM_GOLDEN is not set to the folder of all taps"
)
TOLERANCE = 2e-5  # of the largest magnitude
STREAM = 0.03  # of what feeds a layer norm
CENTRE = np.float32(4 * 65535 // 2)  # of a sum of four
UNIT = 1.0 / math.sqrt(4 * (65536.0**2 - 1) / 12)

# The first pattern that fits wins. 'mul': scale / sqrt(fan in) for weights of two or more
# dimensions, 0.02 scale for others; 'one': scale (1 + 0.1 noise); 'raw': scale.
RULES = [
    (r"(pos_embed|cls_token|mask_token|register_tokens?|camera_token)$", "raw", STREAM),
    (r"^(metric_token|depth_emb)$", "raw", STREAM),
    (r"(^|\.)(patch_embed|ray_embed)\.proj\.(weight|bias)$", "mul", STREAM),
    (r"^(encoder|depth_encoder|aggregator\.patch_embed)\.norm\.weight$", "one", STREAM),
    (r"^(encoder|depth_encoder|aggregator\.patch_embed)\.norm\.bias$", "raw", 0.02 * STREAM),
    (r"^camera_head\.trunk\.\d+\.ls[12]\.gamma$", "one", 0.5 * STREAM),
    (r"\.gamma$", "one", 0.25 * STREAM),
    (r"^camera_head\.token_norm\.weight$", "one", STREAM),
    (r"^camera_head\.token_norm\.bias$", "raw", 0.02 * STREAM),
    (r"^camera_head\.poseLN_modulation\.1\.(weight|bias)$", "mul", 0.15),
    (r"^camera_head\.pose_branch\.fc2\.weight$", "mul", 0.4),
    (r"^(point_head|conf_head)\.proj\.weight$", "mul", 0.3),
    (r"^camera_head\.fc_(t|rot)\.weight$", "mul", 0.5),
    (r"^metric_head\.weight$", "mul", 0.3),
    (r"(^|\.)aggregator\.score\.3\.weight$", "mul", 2.0),
]
# Queries and keys that a norm follows are small, so that its epsilon shows.
NORMED = re.compile(
    r"^(decoder|aggregator\.(frame|global)_blocks|pose_inject_blk)\.\d+\.attn\.qkv\.(weight|bias)$"
)
NORMED_SCALE = np.float32(0.05)
# Added, so that poses are well conditioned: fields of view, and the diagonal of a rotation.
OFFSETS = {
    "camera_head.pose_branch.fc2.bias": [0, 0, 0, 0, 0, 0, 0.25, 0.25, 0.25],
    "camera_head.fc_rot.bias": [0.5, 0, 0, 0, 0.5, 0, 0, 0, 0.5],
}


class Case(NamedTuple):
    """Images and what the original made of them."""

    images: torch.Tensor  # (N, 3, H, W) in [0, 1]
    stride: int  # every so many-th token was kept
    expected: dict[str, Array]
    batch: int = 1
    pixel_stride: int = 1  # every so many-th row and column of maps was kept

    @property
    def windows(self) -> torch.Tensor:
        """(batch, frames, 3, H, W): what a network of windows takes."""
        return self.images.view(self.batch, -1, *self.images.shape[1:])


def load_manifest(model: str) -> dict[str, Any]:
    return dict(json.loads((DATA / model / "manifest.json").read_text()))


def load_case(model: str, name: str, part: str = "case", root: Path = DATA) -> Case:
    meta = json.loads((root / model / f"case_{name}.json").read_text())
    count = meta["batch"] * meta.get("frames", 1)
    images = make_images(meta["seed"], count, meta["height"], meta["width"])
    with np.load(root / model / f"{part}_{name}.npz", allow_pickle=False) as file:
        expected = {key: file[key] for key in file.files}
    strides = meta.get("token_stride", 1), meta.get("pixel_stride", 1)
    return Case(torch.from_numpy(images), strides[0], expected, meta["batch"], strides[1])


def load_every_tap(model: str, name: str) -> Case:
    return load_case(model, name, root=Path(EVERY_TAP))


def load_functions() -> dict[str, Array]:
    """Return inputs and outputs of single functions."""
    with np.load(DATA / "functions" / "functions.npz", allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


def relative_difference(found: torch.Tensor, expected: Array) -> float:
    """Return the largest difference, over the largest magnitude; infinities must be the same."""
    assert tuple(found.shape) == expected.shape
    ours, theirs = found.detach().double().numpy(), expected.astype(np.float64)
    with np.errstate(invalid="ignore"):
        difference = np.where(ours == theirs, 0, ours - theirs)
    return float(np.abs(difference).max() / np.abs(theirs[np.isfinite(theirs)]).max())


def mean_error(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).abs().mean() / expected.abs().mean())


def differences(found: Any, expected: Any) -> dict[str, float]:
    """Compare all that two predictions, named tuples, say."""
    pairs = zip(found._fields, found, expected, strict=True)
    return {name: relative_difference(ours, theirs.numpy()) for name, ours, theirs in pairs}


def assert_same(found: Any, expected: Any, tolerance: float = 1e-5) -> None:
    which = differences(found, expected)
    assert all(value < tolerance for value in which.values()), which


def assert_small(
    which: dict[str, float], num: Container[int], tolerance: float = TOLERANCE
) -> None:
    """Hold all differences to the original to a tolerance; how many there are to ``num``."""
    assert len(which) in num, sorted(which)
    assert all(value < tolerance for value in which.values()), which


def make_tensors(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(make_weights(name, shape)) for name, shape in shapes.items()}


def fill(module: torch.nn.Module, prefix: str = "") -> None:
    """Fill all parameters in place; ``prefix`` and their names are those of the original."""
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            parameter.copy_(torch.from_numpy(make_weights(prefix + name, list(parameter.shape))))


def filled(make: Callable[[], torch.nn.Module]) -> Any:
    """Build a network and draw its weights from their names."""
    with torch.device("meta"):
        network = make()
    network.to_empty(device="cpu")
    fill(network)
    return network.requires_grad_(requires_grad=False).eval()


def make_weights(name: str, shape: list[int]) -> Array:
    kind, scale = _kind_and_scale(name, shape)
    noise = _noise(name, math.prod(shape))
    if kind == "mul":
        values = noise * np.float32(scale * UNIT / math.sqrt(math.prod(shape[1:])))
    elif kind == "one":
        values = np.float32(scale) + noise * np.float32(0.1 * scale * UNIT)
    else:
        values = noise * np.float32(scale * UNIT)
    if NORMED.search(name):
        values[: 2 * len(values) // 3] *= NORMED_SCALE
    if name in OFFSETS:
        values = values + np.asarray(OFFSETS[name], np.float32)
    return np.asarray(values, np.float32).reshape(shape)


def make_images(seed: int, count: int, height: int, width: int) -> Array:
    """Return (count, 3, height, width) smooth-plus-noise frames in [0, 1]."""
    cell = 14
    rows, columns = -(-height // cell), -(-width // cell)
    coarse = _unit_noise(f"image-coarse-{seed}", (count, 3, rows, columns))
    frame = _unit_noise(f"image-frame-{seed}", (count, 3, 1, 1))
    fine = _unit_noise(f"image-fine-{seed}", (count, 3, height, width))
    smooth = coarse.repeat(cell, axis=2).repeat(cell, axis=3)[:, :, :height, :width]
    parts = (np.float32(0.12) * frame, np.float32(0.12) * smooth, np.float32(0.08) * fine)
    out = np.float32(0.5) + parts[0] + parts[1] + parts[2]
    return np.asarray(np.clip(out, np.float32(0), np.float32(1)), np.float32)


def fingerprint(name: str, shape: list[int]) -> str:
    return f"{zlib.crc32(np.ascontiguousarray(make_weights(name, shape)).tobytes()):08x}"


def _kind_and_scale(name: str, shape: list[int]) -> tuple[str, float]:
    is_matrix = name.endswith("weight") and len(shape) > 1
    for pattern, kind, scale in RULES:
        if re.search(pattern, name):
            return ("raw", 0.02 * scale) if kind == "mul" and not is_matrix else (kind, scale)
    if is_matrix:
        return "mul", 1.0
    if name.endswith("bias"):
        return "raw", 0.02
    return ("one", 1.0) if name.endswith("weight") or not shape else ("raw", 1.0)


def _unit_noise(name: str, shape: tuple[int, ...]) -> Array:
    return (_noise(name, math.prod(shape)) * np.float32(UNIT)).reshape(shape)


def _noise(name: str, count: int) -> Array:
    """Return integers around 0 as float32, each the sum of the parts of a 64-bit word."""
    words = np.random.PCG64(zlib.crc32(name.encode())).random_raw(count)
    parts = np.asarray(words, "<u8").view("<u2").reshape(-1, 4)
    return np.asarray(parts.sum(axis=1, dtype=np.uint32).astype(np.float32) - CENTRE)
