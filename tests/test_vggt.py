"""The network VGGT against the original's outputs, its laws, and its checkpoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import golden
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from vggt_taps import compare, run_tapped

from laser_slam.errors import WeightsError
from laser_slam.networks.camera_head import CameraHeadConfig
from laser_slam.networks.dinov2 import EncoderConfig
from laser_slam.networks.dpt import DptConfig
from laser_slam.networks.vggt import Vggt, VggtConfig, VggtOutput, list_unused, load_vggt

FULL = VggtConfig(point_head=True)
MINI = VggtConfig(
    encoder=EncoderConfig(64, 2, 2, num_registers=4),
    depth=4,
    num_heads=2,
    levels=(0, 1, 2, 3),
    dense=DptConfig((16, 32, 64, 64), 32),
    camera=CameraHeadConfig(2, 2),
    point_head=True,
)
SHAPES = {"vggt": FULL, "mini/vggt": MINI}
STEADY = ("depth", "depth_confidence", "tokens", "points", "points_confidence")


def filled(config: VggtConfig) -> Vggt:
    network: Vggt = golden.filled(lambda: Vggt(config))
    return network


@pytest.fixture(scope="module")
def mini() -> Vggt:
    return filled(MINI)


@pytest.fixture(scope="module")
def full() -> Vggt:
    return filled(FULL)


@pytest.fixture
def images() -> Tensor:
    """One window of three frames."""
    return golden.load_case("mini/vggt", "a").windows


@torch.no_grad()
def predict(network: Vggt, images: Tensor) -> VggtOutput:
    out: VggtOutput = network(images)
    return out


def select(out: VggtOutput, frames: list[int]) -> VggtOutput:
    return VggtOutput(*(value[:, frames] for value in out if value is not None))


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_tiny_network_says_what_the_original_says(mini: Vggt, name: str) -> None:
    case = golden.load_case("mini/vggt", name, "network")
    golden.assert_small(compare(mini, case), {18})


@pytest.mark.slow
@pytest.mark.parametrize("name", list("abcdf"))
def test_the_full_network_says_what_the_original_says(full: Vggt, name: str) -> None:
    case = golden.load_case("vggt", name, "network")
    golden.assert_small(compare(full, case), {7})


@pytest.mark.slow
@golden.needs_every_tap
@pytest.mark.parametrize("name", list("abcdf"))
def test_the_full_network_works_as_the_original_does(full: Vggt, name: str) -> None:
    case = golden.load_every_tap("vggt", name)
    golden.assert_small(compare(full, case), range(28, 100))


@pytest.mark.parametrize("model", ["vggt", "mini/vggt"])
@pytest.mark.parametrize("point_head", [True, False])
def test_keys_and_shapes_are_those_of_the_released_checkpoint(model: str, point_head: bool) -> None:
    config = replace(SHAPES[model], point_head=point_head)
    with torch.device("meta"):
        ours = {key: list(value.shape) for key, value in Vggt(config).state_dict().items()}
    unused = ["aggregator.patch_embed.mask_token", "track_head."]
    assert list_unused(config) == (unused if point_head else [*unused, "point_head."])
    theirs = golden.load_manifest(model)["shapes"]
    is_used = {key: not key.startswith(tuple(list_unused(config))) for key in theirs}
    assert ours == {key: shape for key, shape in theirs.items() if is_used[key]}


def test_maps_do_not_depend_on_how_many_frames_are_taken_at_once(
    mini: Vggt, images: Tensor
) -> None:
    whole = predict(mini, images)
    try:
        for chunk in (None, 1, 2):
            mini.config = replace(MINI, chunk=chunk)
            _, seen = run_tapped(mini, images)
            assert len(seen["depth_conv1"]) == {None: 1, 1: 3, 2: 2}[chunk]
            golden.assert_same(predict(mini, images), whole)
    finally:
        mini.config = MINI


def test_windows_of_a_batch_do_not_see_one_another(mini: Vggt) -> None:
    images = golden.load_case("mini/vggt", "b").windows
    alone = [predict(mini, window[None]) for window in images]
    both = VggtOutput(*(torch.cat([a, b]) for a, b in zip(*alone, strict=True)))
    golden.assert_same(predict(mini, images), both)


def test_frames_after_the_first_are_exchangeable(mini: Vggt, images: Tensor) -> None:
    out = predict(mini, images)
    golden.assert_same(predict(mini, images[:, [0, 2, 1]]), select(out, [0, 2, 1]))
    moved = select(predict(mini, images[:, [1, 0, 2]]), [1, 0, 2])
    assert golden.relative_difference(moved.depth, out.depth.numpy()) > 1e-3


@pytest.mark.parametrize("num_frames", [1, 2, 20])
def test_windows_may_be_of_any_length(mini: Vggt, num_frames: int) -> None:
    generator = torch.Generator().manual_seed(num_frames)
    out = predict(mini, torch.rand(1, num_frames, 3, 42, 28, generator=generator))
    assert out.depth.shape == out.depth_confidence.shape == (1, num_frames, 42, 28)
    assert out.points is not None
    assert out.points.shape == (1, num_frames, 42, 28, 3)
    assert out.tokens.shape == (1, num_frames, 64)
    assert out.intrinsics.shape == (1, num_frames, 3, 3)
    assert all(value is not None and value.dtype == torch.float32 for value in out)
    assert bool((out.depth > 0).all())
    assert bool((out.depth_confidence >= 1).all())
    rotations = out.cam_from_world[..., :3, :3]
    eye = torch.eye(3).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, eye, rtol=0, atol=1e-5)
    assert bool((torch.linalg.det(rotations) > 0).all())


def test_tokens_are_means_over_patches_of_the_encoder(mini: Vggt, images: Tensor) -> None:
    patches = golden.load_case("mini/vggt", "a").expected["enc_out"]
    expected = patches.mean(axis=1, keepdims=True).swapaxes(0, 1)
    assert golden.relative_difference(predict(mini, images).tokens, expected) < golden.TOLERANCE


def test_points_are_left_out_unless_asked_for(mini: Vggt, images: Tensor) -> None:
    out = predict(filled(replace(MINI, point_head=False)), images)
    assert out.points is None
    assert out.points_confidence is None
    assert torch.equal(out.depth, predict(mini, images).depth)


def test_heads_look_at_the_levels_that_they_are_told(images: Tensor) -> None:
    config = replace(MINI, depth=6, levels=(0, 2, 3, 4))
    network = filled(config)
    seen = network.aggregator(images)
    _, taps = run_tapped(network, images)
    assert len(seen.levels) == 4
    for index, level in zip(config.levels, seen.levels, strict=True):
        parts = [taps[f"{kind}{index}"][0].reshape(3, 25, 64) for kind in ("frame", "global")]
        torch.testing.assert_close(level, torch.cat(parts, -1)[:, 5:])
    last = [taps[f"{kind}5"][0].reshape(3, 25, 64)[:, 0] for kind in ("frame", "global")]
    torch.testing.assert_close(seen.cameras[0], torch.cat(last, -1))


def test_images_that_are_no_whole_patches_are_refused(mini: Vggt) -> None:
    with pytest.raises(ValueError, match="70x60 px; sides must be multiples of 14"):
        predict(mini, torch.zeros(1, 2, 3, 60, 70))


@pytest.mark.parametrize("how", ["weights", "autocast"])
def test_half_precision_stays_close_and_heads_stay_whole(
    mini: Vggt, images: Tensor, how: str
) -> None:
    """Eight bits of mantissa: 0.4 % each time, which adds up over the layers."""
    expected, exact = run_tapped(mini, images)
    network = filled(MINI) if how == "weights" else mini
    if how == "weights":
        network.aggregator.to(torch.bfloat16)
    with torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"):
        found, seen = run_tapped(network, images)
    errors = [golden.mean_error(getattr(found, name), getattr(expected, name)) for name in STEADY]
    errors.append(golden.mean_error(seen["pose_enc_list"][0], exact["pose_enc_list"][0]))
    assert all(1e-4 < error < 0.02 for error in errors), errors
    assert all(value is not None and value.dtype == torch.float32 for value in found)
    assert seen["frame0"][0].dtype == (torch.bfloat16 if how == "weights" else torch.float32)
    parts = [name for name in seen if name.startswith(("cam", "depth", "point"))]
    assert {out.dtype for name in parts for out in seen[name]} == {torch.float32}


def test_no_part_asks_for_another_device_than_that_of_the_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The meta device computes shapes only, and refuses to meet any other."""
    asked: list[str] = []

    def is_available(device: str) -> bool:
        asked.append(device)
        return False

    monkeypatch.setattr(torch.amp, "is_autocast_available", is_available)
    with torch.device("meta"):
        network = Vggt(MINI)
    out = network(torch.zeros(1, 3, 3, 28, 42, device="meta"))
    assert {value.device.type for value in out} == {"meta"}
    assert out.depth.shape == (1, 3, 28, 42)
    assert asked == ["meta"]


def save_checkpoint(path: Path, *, without: str = "") -> dict[str, Tensor]:
    """Write a tiny checkpoint with all that the released one has, and return it."""
    tensors = golden.make_tensors(golden.load_manifest("mini/vggt")["shapes"])
    tensors |= {f"track_head.{name}": torch.zeros(2) for name in ("tracker.bias", "norm.weight")}
    tensors = {key: value for key, value in tensors.items() if key != without}
    save_file(tensors, path)
    return tensors


@pytest.mark.parametrize("point_head", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_checkpoint_is_loaded_with_the_aggregator_in_the_wanted_precision(
    tmp_path: Path, images: Tensor, dtype: torch.dtype, point_head: bool
) -> None:
    path = tmp_path / "model.safetensors"
    tensors = save_checkpoint(path)
    network = load_vggt(str(path), dtype, replace(MINI, point_head=point_head))
    for key, value in network.state_dict().items():
        assert value.dtype == (dtype if key.startswith("aggregator.") else torch.float32), key
        assert torch.equal(value, tensors[key].to(value.dtype)), key
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    found, expected = predict(network, images), predict(filled(MINI), images)
    assert golden.mean_error(found.depth, expected.depth) < 0.02


@pytest.mark.parametrize("key", ["camera_head.token_norm.weight", "aggregator.camera_token"])
def test_a_checkpoint_that_lacks_a_key_is_refused(tmp_path: Path, key: str) -> None:
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, without=key)
    with pytest.raises(WeightsError) as caught:
        load_vggt(str(path), config=MINI)
    message = str(caught.value)
    assert f"is no model.safetensors: 1 missing ({key}); download" in message
    assert "5.03 GB, CC BY-NC 4.0" in message
    assert "facebook/VGGT-1B-Commercial" in message
    assert "backbone.vggt.weights" in message
