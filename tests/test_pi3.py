"""The network pi3 against the original's outputs, its laws, and its checkpoint."""

from __future__ import annotations

from pathlib import Path

import golden
import numpy as np
import pytest
import torch
from pi3_taps import compare, tapped
from safetensors.torch import save_file
from torch import Tensor

from laser_slam.errors import WeightsError
from laser_slam.networks.dinov2 import IMAGE_MEAN, IMAGE_STD, EncoderConfig
from laser_slam.networks.heads import PixelHead, nearest_rotations
from laser_slam.networks.pi3 import Pi3, Pi3Config, Pi3Output, load_pi3

MINI = Pi3Config(
    EncoderConfig(64, 2, 2, num_registers=4), depth=4, num_heads=2, head_depth=2, camera_width=32
)
SHAPES = {"pi3": Pi3Config(), "mini/pi3": MINI}
HEADS = ("point_head.", "conf_head.", "camera_head.")
CONSTANTS = {"image_mean", "image_std"}


def filled(config: Pi3Config) -> Pi3:
    network: Pi3 = golden.filled(lambda: Pi3(config))
    return network


@pytest.fixture(scope="module")
def mini() -> Pi3:
    return filled(MINI)


@pytest.fixture(scope="module")
def full() -> Pi3:
    return filled(Pi3Config())


@pytest.fixture
def images() -> Tensor:
    """One window of three frames, 70x56 px."""
    return golden.load_case("mini/pi3", "a").windows


@torch.no_grad()
def predict(network: Pi3, images: Tensor) -> Pi3Output:
    out: Pi3Output = network(images)
    return out


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_tiny_network_says_what_the_original_says(mini: Pi3, name: str) -> None:
    case = golden.load_case("mini/pi3", name, "network")
    golden.assert_small(compare(mini, case), {12})


@pytest.mark.slow
@pytest.mark.parametrize("name", list("abcde"))
def test_the_full_network_says_what_the_original_says(full: Pi3, name: str) -> None:
    case = golden.load_case("pi3", name, "network")
    golden.assert_small(compare(full, case), {6})


@pytest.mark.slow
@golden.needs_every_tap
@pytest.mark.parametrize("name", list("abcde"))
def test_the_full_network_works_as_the_original_does(full: Pi3, name: str) -> None:
    case = golden.load_every_tap("pi3", name)
    golden.assert_small(compare(full, case), range(13, 100))


@pytest.mark.parametrize("model", ["pi3", "mini/pi3"])
def test_keys_and_shapes_are_those_of_the_released_checkpoint(model: str) -> None:
    with torch.device("meta"):
        ours = {key: list(value.shape) for key, value in Pi3(SHAPES[model]).state_dict().items()}
    theirs = golden.load_manifest(model)["shapes"]
    assert theirs.keys() - ours.keys() == CONSTANTS
    assert ours == {key: shape for key, shape in theirs.items() if key not in CONSTANTS}


def test_rotations_are_the_nearest_as_the_original_finds_them() -> None:
    known = golden.load_functions()
    found = nearest_rotations(torch.from_numpy(known["svd_in_9"]).view(-1, 3, 3))
    assert golden.relative_difference(found, known["svd_out_rotation"]) < 1e-5


def test_pixels_of_a_patch_are_laid_out_as_the_originals() -> None:
    known = golden.load_functions()
    head = PixelHead(16, 3)
    golden.fill(head, "point_head.")
    assert golden.relative_difference(head.proj.weight, known["pixel_head_weight"]) == 0
    maps = head(torch.from_numpy(known["pixel_head_tokens"]), (2, 3))
    assert golden.relative_difference(maps, known["pixel_head_out_bhwc"]) < 1e-6


def test_outputs_do_not_depend_on_how_many_frames_the_heads_take_at_once(
    mini: Pi3, images: Tensor
) -> None:
    whole = predict(mini, images)
    try:
        for chunk, calls in ((None, 1), (1, 3), (2, 2), (50, 1)):
            mini.chunk = chunk
            with tapped(mini) as seen:
                golden.assert_same(predict(mini, images), whole)
            assert len(seen["point_hidden"]) == len(seen["camera_hidden"]) == calls
    finally:
        mini.chunk = None


def test_windows_of_a_batch_do_not_see_one_another(mini: Pi3) -> None:
    images = golden.load_case("mini/pi3", "b").windows
    alone = [predict(mini, window[None]) for window in images]
    both = Pi3Output(*(torch.cat([a, b]) for a, b in zip(*alone, strict=True)))
    golden.assert_same(predict(mini, images), both)


def test_no_frame_is_the_first(mini: Pi3, images: Tensor) -> None:
    out = predict(mini, images)
    for order in ([0, 2, 1], [2, 0, 1]):
        moved = Pi3Output(*(value[:, order] for value in out))
        golden.assert_same(predict(mini, images[:, order]), moved)


def test_frames_of_a_window_see_one_another_and_tokens_do_not(mini: Pi3, images: Tensor) -> None:
    other = images.clone()
    other[:, 2] = 1 - other[:, 2]
    before, after = predict(mini, images), predict(mini, other)
    assert torch.equal(before.tokens[:, :2], after.tokens[:, :2])
    assert not torch.allclose(before.tokens[:, 2], after.tokens[:, 2])
    for name in ("local_points", "confidence", "window_from_cam"):
        ours, theirs = getattr(before, name)[:, :2], getattr(after, name)[:, :2]
        assert golden.relative_difference(ours, theirs.numpy()) > 1e-4, name


@pytest.mark.parametrize("num_frames", [1, 2, 20])
def test_windows_may_be_of_any_length(mini: Pi3, num_frames: int) -> None:
    generator = torch.Generator().manual_seed(num_frames)
    out = predict(mini, torch.rand(1, num_frames, 3, 42, 28, generator=generator))
    assert out.local_points.shape == (1, num_frames, 42, 28, 3)
    assert out.confidence.shape == (1, num_frames, 42, 28)
    assert out.tokens.shape == (1, num_frames, 64)
    assert all(value.dtype == torch.float32 for value in out)
    assert bool((out.local_points[..., 2] > 0).all())
    rotations = out.window_from_cam[..., :3, :3]
    eye = torch.eye(3).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, eye, rtol=0, atol=1e-5)
    assert bool((torch.linalg.det(rotations) > 0).all())
    assert out.window_from_cam[0, :, 3].tolist() == [[0, 0, 0, 1]] * num_frames


def test_tokens_are_means_over_patches_of_the_encoder(mini: Pi3, images: Tensor) -> None:
    patches = golden.load_case("mini/pi3", "a").expected["enc_out"]
    expected = patches.mean(axis=1)[None]
    assert golden.relative_difference(predict(mini, images).tokens, expected) < golden.TOLERANCE


def test_images_that_are_no_whole_patches_are_refused(mini: Pi3) -> None:
    with pytest.raises(ValueError, match="70x60 px; sides must be multiples of 14"):
        predict(mini, torch.zeros(1, 2, 3, 60, 70))


def halve(network: Pi3) -> Pi3:
    for name, child in network.named_children():
        if f"{name}." not in HEADS:
            child.to(torch.bfloat16)
    return network


@pytest.mark.parametrize("how", ["weights", "autocast"])
def test_half_precision_stays_close_and_heads_stay_whole(
    mini: Pi3, images: Tensor, how: str
) -> None:
    """Eight bits of mantissa: 0.4 % each time, which adds up over the layers."""
    expected = predict(mini, images)
    network = halve(filled(MINI)) if how == "weights" else mini
    with torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"), tapped(network) as seen:
        found = predict(network, images)
    errors = [golden.mean_error(ours, theirs) for ours, theirs in zip(found, expected, strict=True)]
    assert all(1e-4 < error < 0.03 for error in errors), errors
    assert all(value.dtype == torch.float32 for value in found)
    assert seen["dec0_qkv"][0].dtype == seen["point_hidden"][0].dtype == torch.bfloat16
    assert {seen[name][0].dtype for name in ("point_raw", "cam_t", "cam_rot9")} == {torch.float32}


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
        network = Pi3(MINI)
    out = network(torch.zeros(1, 3, 3, 28, 42, device="meta"))
    assert {value.device.type for value in out} == {"meta"}
    assert out.local_points.shape == (1, 3, 28, 42, 3)
    assert set(asked) == {"meta"}


def save_checkpoint(path: Path) -> dict[str, Tensor]:
    """Write a tiny checkpoint with all that the released one has, and return it."""
    tensors = golden.make_tensors(golden.load_manifest("mini/pi3")["shapes"])
    tensors["image_mean"] = torch.tensor(IMAGE_MEAN).view(1, 3, 1, 1)
    tensors["image_std"] = torch.tensor(IMAGE_STD).view(1, 3, 1, 1)
    save_file(tensors, path)
    return tensors


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_checkpoint_is_loaded_with_encoder_and_decoders_in_the_wanted_precision(
    tmp_path: Path, images: Tensor, dtype: torch.dtype
) -> None:
    path = tmp_path / "model.safetensors"
    tensors = save_checkpoint(path)
    network = load_pi3(str(path), dtype, MINI)
    for key, value in network.state_dict().items():
        assert value.dtype == (torch.float32 if key.startswith(HEADS) else dtype), key
        assert torch.equal(value, tensors[key].to(value.dtype)), key
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    found, expected = predict(network, images), predict(filled(MINI), images)
    assert golden.mean_error(found.local_points, expected.local_points) < 0.03


def test_a_checkpoint_for_images_normalised_otherwise_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    tensors = save_checkpoint(path)
    save_file(tensors | {"image_std": torch.full((1, 3, 1, 1), 0.5)}, path)
    with pytest.raises(WeightsError, match=r"model.safetensors: 1 of other values \(image_std\); "):
        load_pi3(str(path), config=MINI)
    half = {key: value.to(torch.bfloat16) for key, value in tensors.items()}
    save_file(half, path)
    load_pi3(str(path), config=MINI)


def test_a_checkpoint_of_another_network_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_file(golden.make_tensors(golden.load_manifest("mini/dinov2-salad")["shapes"]), path)
    with pytest.raises(WeightsError, match=r"missing .* CC BY-NC 4.0.*backbone.pi3.weights$") as e:
        load_pi3(str(path), config=MINI)
    assert "\n" not in str(e.value)


def test_tiny_outputs_are_no_constants(mini: Pi3, images: Tensor) -> None:
    """Else the laws above would hold of nothing."""
    for value in predict(mini, images):
        assert float(np.std(value.numpy(), axis=1).mean()) > 1e-3
