"""What the modules of pi3 and pi3x say on the way, under the names of what the original's say."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import golden
import torch
from torch import Tensor, nn

from laser_slam.networks.conditioning import Conditions
from laser_slam.networks.heads import pose_points
from laser_slam.networks.pi3 import Pi3, Pi3Output
from laser_slam.networks.pi3x import Pi3X, Pi3XOutput
from laser_slam.networks.trunk import Trunk

TAPPED = (0, 1, 11, 23, 34, 35)  # blocks that were kept where not all were
DENSE = ("points", "local_points", "conf", "rays", "point_raw")
HALF_PIXEL = 0.5  # by which the original's pixel centres are off integers

Seen = dict[str, list[Tensor]]  # outputs of a module, call after call
Output = Pi3Output | Pi3XOutput


def compare(network: Pi3 | Pi3X, case: golden.Case) -> dict[str, float]:
    """Return the relative difference for everything but what the encoder's tests look at."""
    with tapped(network) as seen, torch.no_grad():
        out = network(case.windows, *told(case))
    found = name_outputs(out) | {"point_raw": case.windows.new_zeros(0)}
    if isinstance(network, Pi3):
        found["point_raw"] = seen["point_raw"][0].view_as(out.local_points)
    keys = [key for key in case.expected if not key.startswith(("enc_", "cond_"))]
    return {key: _compare_one(key, case, found, seen) for key in keys}


def told(case: golden.Case) -> list[Conditions]:
    """Return the conditions of a case, if it has any, with our pixel centres."""
    if "cond_depths" not in case.expected:
        return []
    names = ("cond_depths", "cond_intrinsics", "cond_poses")
    depths, intrinsics, poses = (torch.tensor(case.expected[name]) for name in names)
    intrinsics[..., :2, 2] -= HALF_PIXEL
    return [Conditions(depths, intrinsics, poses)]


@contextmanager
def tapped(network: Trunk) -> Iterator[Seen]:
    """Collect what modules say while it lasts."""
    seen: Seen = {}

    def keep(name: str) -> Callable[..., None]:
        return lambda _module, _inputs, out: seen.setdefault(name, []).append(out)

    hooks = [
        module.register_forward_hook(keep(name)) for name, module in name_modules(network).items()
    ]
    decoder = network.point_decoder
    hooks.append(
        decoder.register_forward_pre_hook(
            lambda _m, inputs: seen.setdefault("dec_out", []).append(inputs[0])
        )
    )
    try:
        yield seen
    finally:
        for hook in hooks:
            hook.remove()


def name_modules(network: Trunk) -> dict[str, nn.Module]:
    camera, first = network.camera_head, network.decoder.get_submodule("0.attn")
    named: dict[str, nn.Module] = {
        "dec0_qkv": first.get_submodule("qkv"),
        "dec0_q_normed": first.get_submodule("q_norm"),
        "point_hidden": network.point_decoder,
        "conf_hidden": network.conf_decoder,
        "camera_hidden": network.camera_decoder,
        "cam_t": camera.fc_t,
        "cam_rot9": camera.fc_rot,
        "cam_feat": camera.more_mlps,
    }
    named |= {f"dec{i}": block for i, block in enumerate(network.decoder)}
    if isinstance(network, Pi3):
        return named | {"point_raw": network.point_head}
    assert isinstance(network, Pi3X)
    named |= {"metric_raw": network.metric_head, "metric_hidden": network.metric_decoder}
    for name, head in (("point", network.point_head), ("conf", network.conf_head)):
        named |= {f"{name}_up{i}": stage for i, stage in enumerate(head.upsample_blocks)}
    named |= {"depth_enc_out": network.depth_encoder.norm, "ray_emb": network.ray_embed}
    return named | {f"pose_inject{i}": block for i, block in enumerate(network.pose_inject_blk)}


def name_outputs(out: Output) -> dict[str, Tensor]:
    points = out.local_points
    found = {
        "local_points": points,
        "conf": out.confidence[..., None],
        "camera_poses": out.window_from_cam,
        "points": pose_points(out.window_from_cam, points),
        "rays": nn.functional.normalize(points, dim=-1),
    }
    return found | ({"metric": out.metric} if isinstance(out, Pi3XOutput) else {})


def _compare_one(key: str, case: golden.Case, found: dict[str, Tensor], seen: Seen) -> float:
    expected = case.expected[key]
    if key in DENSE:
        step = case.pixel_stride
        return golden.relative_difference(found[key][:, :, ::step, ::step], expected)
    value = found[key] if key in found else _pick(key, seen, case, expected)
    return golden.relative_difference(value.reshape(expected.shape), expected)


def _pick(key: str, seen: Seen, case: golden.Case, expected: golden.Array) -> Tensor:
    """Return what a module said, at the places that were kept."""
    match = re.fullmatch(r"(.+?)(?:_c(\d+))?", key)
    assert match is not None
    name, channels = match[1], slice(int(match[2]) if match[2] else None)
    if "_up" in name:
        step = 2 ** int(name[-1])
        return seen[name][0][:, channels, ::step, ::step]
    special = {
        "dec_out_c8": lambda: _both_halves(seen["dec_out"][0])[:, :: case.stride],
        "dec0_qkv_tok7": lambda: seen["dec0_qkv"][0][:, 6],
        "dec0_q_normed_head0": lambda: seen["dec0_q_normed"][0][:, 0],
        "depth_enc_out": lambda: seen["depth_enc_out"][0][:, 5:, channels],
        "ray_emb": lambda: seen["ray_emb"][0][..., channels],
        "metric_hidden": lambda: seen["metric_hidden"][0][..., channels],
    }
    if name in special:
        return special[name]()
    if name == "dec_blocks":
        indices = TAPPED if len(expected) == len(TAPPED) else range(len(expected))
        blocks = [_by_frame(seen[f"dec{i}"][0], case) for i in indices]
        return torch.stack(blocks)[:, :, :: case.stride, channels]
    if name == "pose_inject":
        injected = [seen[f"pose_inject{i}"][0] for i in range(len(expected))]
        return torch.stack(injected)[..., channels]
    value = _by_frame(seen[name][0], case) if seen[name][0].ndim > 2 else seen[name][0]
    return value[:, :: case.stride, channels] if value.ndim > 2 else value


def _both_halves(tokens: Tensor) -> Tensor:
    """Return the first 8 channels of each half of (F, T, 2 D)."""
    return torch.cat([half[..., :8] for half in tokens.chunk(2, dim=-1)], dim=-1)


def _by_frame(tokens: Tensor, case: golden.Case) -> Tensor:
    """Return (B N, T, D) of blocks within or across frames."""
    return tokens.reshape(len(case.images), -1, tokens.shape[-1])
