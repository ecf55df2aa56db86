"""What VGGT's modules say on the way, under the names of what was kept of the original."""

import re
from collections.abc import Callable

import golden
import torch
from torch import Tensor, nn

from laser_slam.networks.dpt import DenseHead
from laser_slam.networks.vggt import NUM_SPECIAL, Vggt, VggtOutput

TAPPED = (0, 5, 11, 17, 23)  # blocks that were kept where not all were
MAPS = ("depth", "depth_conf", "world_points", "world_points_conf")
EVERY_CHANNEL = 8  # so many-th of fused maps was kept of the tiny network

Seen = dict[str, list[Tensor]]  # outputs of a module, call after call


def compare(network: Vggt, case: golden.Case) -> dict[str, float]:
    """Return the relative difference for everything that was kept of the original."""
    out, seen = run_tapped(network, case.windows)
    found = name_outputs(out, seen, case.pixel_stride)
    for key, expected in case.expected.items():
        if key not in found:
            found[key] = _pick(key, seen, case, expected)
    return {
        key: golden.relative_difference(found[key], case.expected[key]) for key in case.expected
    }


@torch.no_grad()
def run_tapped(network: Vggt, images: Tensor) -> tuple[VggtOutput, Seen]:
    seen: Seen = {"agg_in": []}

    def keep(name: str) -> Callable[..., None]:
        return lambda _module, _inputs, out: seen.setdefault(name, []).append(out)

    named = _name_modules(network)
    hooks = [module.register_forward_hook(keep(name)) for name, module in named.items()]
    first = network.aggregator.frame_blocks[0]
    hooks.append(first.register_forward_pre_hook(lambda _m, ins: seen["agg_in"].append(ins[0])))
    out = network(images)
    for hook in hooks:
        hook.remove()
    return out, seen


def name_outputs(out: VggtOutput, seen: Seen, stride: int) -> dict[str, Tensor]:
    assert out.points is not None
    assert out.points_confidence is not None
    maps = (out.depth[..., None], out.depth_confidence, out.points, out.points_confidence)
    found = {key: value[:, :, ::stride, ::stride] for key, value in zip(MAPS, maps, strict=True)}
    steps = seen["pose_enc_list"][0]
    return found | {
        "pose_enc_list": steps,
        "pose_enc": steps[-1],
        "extrinsic_w2c": out.cam_from_world[..., :3, :],
        "intrinsic": out.intrinsics,
    }


def _name_modules(network: Vggt) -> dict[str, nn.Module]:
    aggregator, camera = network.aggregator, network.camera_head
    named: dict[str, nn.Module] = {
        "enc_out": aggregator.patch_embed.norm,
        "pose_enc_list": camera,
        "cam_token_norm": camera.token_norm,
        "cam_trunk": camera.trunk,
        "cam_delta": camera.pose_branch,
    }
    named |= {f"enc{i}": block for i, block in enumerate(aggregator.patch_embed.blocks)}
    named |= {f"frame{i}": block for i, block in enumerate(aggregator.frame_blocks)}
    named |= {f"global{i}": block for i, block in enumerate(aggregator.global_blocks)}
    assert network.point_head is not None
    return (
        named | _name_parts("depth", network.depth_head) | _name_parts("point", network.point_head)
    )


def _name_parts(kind: str, head: DenseHead) -> dict[str, nn.Module]:
    scratch = head.scratch
    named: dict[str, nn.Module] = {f"{kind}_conv1": scratch.output_conv1}
    named[f"{kind}_conv2_raw"] = scratch.output_conv2
    named |= {f"{kind}_proj{i}": layer for i, layer in enumerate(head.projects)}
    named |= {f"{kind}_resize{i}": layer for i, layer in enumerate(head.resize_layers)}
    return named | {f"{kind}_refine{i}": getattr(scratch, f"refinenet{i}") for i in range(1, 5)}


def _pick(key: str, seen: Seen, case: golden.Case, expected: golden.Array) -> Tensor:
    """Return what modules said, at the places that were kept."""
    match = re.fullmatch(r"(.+?)(?:_c(\d+))?", key)
    assert match is not None
    name, channels = match[1], slice(int(match[2]) if match[2] else None)
    if name.startswith(("depth_", "point_")):
        return _pick_maps(torch.cat(seen[name]), channels, expected)
    if name.startswith("cam_"):
        steps = torch.stack(seen[name])[..., channels]
        return steps if expected.ndim == steps.ndim else steps[0]
    if name.endswith("_blocks"):
        kind = name.removesuffix("_blocks")
        indices = TAPPED if len(expected) == len(TAPPED) else range(len(expected))
        blocks = [_by_frame(seen[f"{kind}{i}"][0], case) for i in indices]
        return torch.stack(blocks)[:, :, :: case.stride, channels]
    tokens = _by_frame(seen[name][0], case)
    tokens = tokens[:, NUM_SPECIAL:] if name == "enc_out" else tokens
    return tokens[:, :: case.stride, channels]


def _pick_maps(maps: Tensor, channels: slice, expected: golden.Array) -> Tensor:
    """Return the first frames (the original took eight at once) and pixels of (B, C, h, w)."""
    step = -(-maps.shape[-2] // expected.shape[-2])
    if channels.stop is None and maps.shape[1] > expected.shape[1]:
        channels = slice(None, None, EVERY_CHANNEL)
    return maps[: len(expected), channels, ::step, ::step]


def _by_frame(tokens: Tensor, case: golden.Case) -> Tensor:
    """Return (B N, T, D) of blocks within or across frames."""
    return tokens.reshape(len(case.images), -1, tokens.shape[-1])
