"""The network pi3x against the original's outputs, its laws, and its checkpoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import golden
import pytest
import torch
from pi3_taps import compare, tapped
from safetensors.torch import save_file
from test_conditioning import make_told
from torch import Tensor

from laser_slam.errors import WeightsError
from laser_slam.networks.dinov2 import IMAGE_MEAN, IMAGE_STD, EncoderConfig
from laser_slam.networks.metric import MetricConfig
from laser_slam.networks.pi3x import Conditions, Pi3X, Pi3XConfig, Pi3XOutput, load_pi3x

ENCODER = EncoderConfig(64, 2, 2, num_registers=4)
MINI = Pi3XConfig(
    ENCODER,
    depth=4,
    num_heads=2,
    head_depth=2,
    camera_width=32,
    depth_encoder=replace(ENCODER, channels=2),
    channels=(32, 32, 32),
    metric=MetricConfig(32, 2, 2),
    injected_after=(1, 3),
)
TOLERANCE = 3e-5  # of the largest magnitude
HEADS = ("point_head.", "conf_head.", "camera_head.", "metric_head.")
CONSTANTS = {"image_mean", "image_std"}
BRANCH = ("depth_encoder.", "depth_emb", "ray_embed.", "pose_inject_blk.")
KINDS = ("depths", "intrinsics", "world_from_cam")


def filled(config: Pi3XConfig) -> Pi3X:
    network: Pi3X = golden.filled(lambda: Pi3X(config))
    return network


@pytest.fixture(scope="module")
def mini() -> Pi3X:
    return filled(MINI)


@pytest.fixture(scope="module")
def full() -> Pi3X:
    return filled(Pi3XConfig())


@pytest.fixture
def images() -> Tensor:
    """One window of three frames, 70x56 px."""
    return golden.load_case("mini/pi3", "a").windows


@pytest.fixture
def told() -> Conditions:
    return Conditions(*make_told())


@torch.no_grad()
def predict(network: Pi3X, images: Tensor, told: Conditions | None = None) -> Pi3XOutput:
    out: Pi3XOutput = network(images, told)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("name", list("abcg"))
def test_the_full_network_says_what_the_original_says(full: Pi3X, name: str) -> None:
    case = golden.load_case("pi3x", name, "network")
    golden.assert_small(compare(full, case), {8}, TOLERANCE)


@pytest.mark.slow
@golden.needs_every_tap
@pytest.mark.parametrize("name", list("abcg"))
def test_the_full_network_works_as_the_original_does(full: Pi3X, name: str) -> None:
    case = golden.load_every_tap("pi3x", name)
    golden.assert_small(compare(full, case), {23 if name == "g" else 20}, TOLERANCE)


@pytest.mark.parametrize("takes_conditions", [True, False])
def test_keys_and_shapes_are_those_of_the_released_checkpoint(takes_conditions: bool) -> None:
    with torch.device("meta"):
        network = Pi3X(Pi3XConfig(takes_conditions=takes_conditions))
    ours = {key: list(value.shape) for key, value in network.state_dict().items()}
    theirs = golden.load_manifest("pi3x")["shapes"]
    left_out = {key for key in theirs if key.startswith(BRANCH) and not takes_conditions}
    assert theirs.keys() - ours.keys() == CONSTANTS | left_out
    assert ours == {key: shape for key, shape in theirs.items() if key in ours}


def test_outputs_do_not_depend_on_how_many_frames_the_heads_take_at_once(
    mini: Pi3X, images: Tensor
) -> None:
    whole = predict(mini, images)
    try:
        for chunk, calls in ((None, 1), (1, 3), (2, 2)):
            mini.chunk = chunk
            with tapped(mini) as seen:
                golden.assert_same(predict(mini, images), whole)
            assert len(seen["point_up2"]) == calls
    finally:
        mini.chunk = None


def test_windows_of_a_batch_do_not_see_one_another(
    mini: Pi3X, images: Tensor, told: Conditions
) -> None:
    depths, intrinsics, poses = make_told()
    others = Conditions(depths * 3, intrinsics, poses[:, [0, 2, 1]])
    windows, tolds = [images, images.flip(1)], [told, others]
    alone = [predict(mini, window, known) for window, known in zip(windows, tolds, strict=True)]
    both = Pi3XOutput(*(torch.cat(pair) for pair in zip(*alone, strict=True)))
    known = Conditions(
        torch.cat([depths, depths * 3]),
        torch.cat([intrinsics, intrinsics]),
        torch.cat([poses, poses[:, [0, 2, 1]]]),
    )
    golden.assert_same(predict(mini, torch.cat(windows), known), both)


@pytest.mark.parametrize("is_told", [False, True])
def test_no_frame_is_the_first_but_for_the_axes_of_poses_that_are_told(
    mini: Pi3X, images: Tensor, is_told: bool
) -> None:
    order = [0, 2, 1]  # the first stays: its axes are the window's
    parts = make_told()
    known = Conditions(*parts) if is_told else None
    known_moved = Conditions(*(part[:, order] for part in parts)) if is_told else None
    out = predict(mini, images, known)
    moved = Pi3XOutput(*(value[:, order] if value.ndim > 1 else value for value in out))
    golden.assert_same(predict(mini, images[:, order], known_moved), moved)


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_condition_is_heard_by_itself(
    mini: Pi3X, images: Tensor, told: Conditions, kind: str
) -> None:
    free = predict(mini, images)
    heard = predict(mini, images, Conditions(**{kind: getattr(told, kind)}))
    found = golden.differences(heard, free)
    assert found.pop("tokens") == 0
    assert min(found.values()) > 1e-4
    golden.assert_same(predict(mini, images, Conditions()), free, tolerance=1e-6)


def test_units_of_depths_and_poses_and_axes_of_the_world_do_not_matter(
    mini: Pi3X, images: Tensor, told: Conditions
) -> None:
    out = predict(mini, images, told)
    depths, intrinsics, world_from_cam = make_told()
    poses = torch.linalg.inv(world_from_cam[:, 1:2]) @ world_from_cam
    poses[..., :3, 3] *= 100
    same = Conditions(depths * 100, intrinsics, poses)
    golden.assert_same(predict(mini, images, same), out, tolerance=1e-4)


def test_the_pose_of_one_frame_says_nothing(mini: Pi3X, images: Tensor) -> None:
    _, _, world_from_cam = make_told()
    heard = predict(mini, images[:, 2:], Conditions(world_from_cam=world_from_cam[:, 2:]))
    golden.assert_same(heard, predict(mini, images[:, 2:]), tolerance=1e-6)


@pytest.mark.parametrize("num_frames", [1, 20])
def test_windows_may_be_of_any_length(mini: Pi3X, num_frames: int) -> None:
    generator = torch.Generator().manual_seed(num_frames)
    out = predict(mini, torch.rand(1, num_frames, 3, 42, 28, generator=generator))
    assert out.local_points.shape == (1, num_frames, 42, 28, 3)
    assert out.confidence.shape == (1, num_frames, 42, 28)
    assert out.metric.shape == (1,)
    assert all(value.dtype == torch.float32 for value in out)
    assert bool((out.local_points[..., 2] > 0).all())


def halve(network: Pi3X) -> Pi3X:
    kept = {name: value.clone() for name, value in network.state_dict().items()}
    network.to(torch.bfloat16)
    for name, child in network.named_children():
        if f"{name}." in HEADS:
            child.float()
    values = {name: value.to(network.state_dict()[name].dtype) for name, value in kept.items()}
    network.load_state_dict(values)
    return network


@pytest.mark.parametrize("is_told", [False, True])
@pytest.mark.parametrize("how", ["weights", "autocast"])
def test_half_precision_stays_close_and_heads_stay_whole(
    mini: Pi3X, images: Tensor, told: Conditions, how: str, is_told: bool
) -> None:
    """Eight bits of mantissa: 0.4 % each time, which adds up over the layers."""
    known = told if is_told else None
    expected = predict(mini, images, known)
    network = halve(filled(MINI)) if how == "weights" else mini
    with torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"), tapped(network) as seen:
        found = predict(network, images, known)
    errors = [golden.mean_error(ours, theirs) for ours, theirs in zip(found, expected, strict=True)]
    assert all(1e-5 < error < 0.03 for error in errors), errors
    assert all(value.dtype == torch.float32 for value in found)
    assert {seen[name][0].dtype for name in ("point_up0", "conf_up2", "metric_raw")} == {
        torch.float32
    }


def test_no_part_asks_for_another_device_than_that_of_the_images() -> None:
    """The meta device computes shapes only, and refuses to meet any other."""
    with torch.device("meta"):
        network = Pi3X(MINI)
        told = Conditions(torch.ones(1, 3, 28, 42), torch.eye(3).expand(1, 3, 3, 3), None)
    images = torch.zeros(1, 3, 3, 28, 42, device="meta")
    out = network(images, told._replace(world_from_cam=torch.empty(1, 3, 4, 4, device="meta")))
    assert {value.device.type for value in out} == {"meta"}


def save_checkpoint(path: Path, *, without: tuple[str, ...] = ()) -> dict[str, Tensor]:
    """Write a tiny checkpoint with all that the released one has, and return it."""
    with torch.device("meta"):
        network = Pi3X(MINI)
    tensors = golden.make_tensors({k: list(v.shape) for k, v in network.state_dict().items()})
    tensors["image_mean"] = torch.tensor(IMAGE_MEAN).view(1, 3, 1, 1)
    tensors["image_std"] = torch.tensor(IMAGE_STD).view(1, 3, 1, 1)
    save_file({k: v for k, v in tensors.items() if not (without and k.startswith(without))}, path)
    return tensors


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_checkpoint_is_loaded_with_encoders_and_decoders_in_the_wanted_precision(
    tmp_path: Path, dtype: torch.dtype
) -> None:
    path = tmp_path / "model.safetensors"
    tensors = save_checkpoint(path)
    network = load_pi3x(str(path), dtype, MINI)
    for key, value in network.state_dict().items():
        assert value.dtype == (torch.float32 if key.startswith(HEADS) else dtype), key
        assert torch.equal(value, tensors[key].to(value.dtype)), key
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize("is_there", [True, False])
def test_the_part_that_takes_conditions_may_be_left_out_on_demand(
    tmp_path: Path, mini: Pi3X, images: Tensor, told: Conditions, is_there: bool
) -> None:
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, without=() if is_there else BRANCH)
    network = load_pi3x(str(path), config=replace(MINI, takes_conditions=False))
    golden.assert_same(predict(network, images), predict(mini, images), tolerance=1e-6)
    with pytest.raises(ValueError, match="takes_conditions=False"):
        predict(network, images, told)


@pytest.mark.parametrize("without", [BRANCH, ("pose_inject_blk.",)])
def test_a_checkpoint_without_that_part_is_refused_by_default(
    tmp_path: Path, without: tuple[str, ...]
) -> None:
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, without=without)
    with pytest.raises(WeightsError, match=r"\d+ missing \((depth_emb|pose_inject_blk)"):
        load_pi3x(str(path), config=MINI)
