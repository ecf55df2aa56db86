"""The image encoder against the original's outputs, and what loading weights refuses."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import golden
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from laser_slam.errors import DependencyError, WeightsError
from laser_slam.networks import dinov2
from laser_slam.networks.dinov2 import BASE, LARGE_WITH_REGISTERS, Encoder, EncoderConfig
from laser_slam.networks.weights import Checkpoint, load_weights

TINY = EncoderConfig(64, 2, 2, num_registers=4)
PREFIX = {"pi3": "encoder.", "vggt": "aggregator.patch_embed."}
TAPPED = (0, 5, 11, 17, 23)  # blocks that were kept where not all were
CHECKPOINT = Checkpoint("a.setting", "tiny.pt", "https://example.org/tiny.pt", "1 MB", "CC0")


def filled(config: EncoderConfig, prefix: str) -> Encoder:
    encoder = Encoder(config)
    golden.fill(encoder, prefix)
    return encoder.eval()


@pytest.fixture(scope="module")
def tiny() -> Encoder:
    return filled(TINY, "encoder.")


@torch.no_grad()
def taps(encoder: Encoder, case: golden.Case) -> dict[str, Tensor]:
    """Return what the original's outputs are named for, at the tokens that were kept."""
    outs: list[Tensor] = []
    hooks = [
        block.register_forward_hook(lambda _module, _tokens, out: outs.append(out))
        for block in encoder.blocks
    ]
    rows, columns = (side // 14 for side in case.images.shape[-2:])
    out = encoder(case.images).patches
    for hook in hooks:
        hook.remove()
    patches = encoder.patch_embed(case.images)
    expected = case.expected.get("enc_blocks_c8")
    if expected is not None and len(expected) < len(outs):
        outs = [outs[i] for i in TAPPED]
    found = {
        "enc_pos_embed_c8": encoder.positions(rows, columns)[0, :: case.stride, :8],
        "enc_patch_embed_c8": patches[:, :: case.stride, :8],
        "enc_in_c8": encoder.embed(case.images)[:, :: case.stride, :8],
        "enc_blocks_c8": torch.stack(outs)[:, :, :: case.stride, :8],
        "enc_out_c8": out[:, :: case.stride, :8],
        "enc_out_tok0_full": out[:, 0],
        "enc_out": out,
    }
    return {key: found[key] for key in case.expected}


@pytest.mark.parametrize("name", ["a", "b"])
@pytest.mark.parametrize("model", ["pi3", "vggt"])
def test_a_tiny_encoder_says_what_the_original_says(model: str, name: str) -> None:
    case = golden.load_case(f"mini/{model}", name)
    found = taps(filled(TINY, PREFIX[model]), case)["enc_out"]
    assert golden.relative_difference(found, case.expected["enc_out"]) < golden.TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize(("model", "names"), [("pi3", "abcde"), ("vggt", "abcdf")])
def test_the_full_encoder_says_what_the_original_says(model: str, names: str) -> None:
    encoder = filled(LARGE_WITH_REGISTERS, PREFIX[model])
    for name in names:
        case = golden.load_case(model, name)
        found = taps(encoder, case)
        differences = {
            key: golden.relative_difference(found[key], case.expected[key]) for key in found
        }
        assert max(differences.values()) < golden.TOLERANCE, (name, differences)


@pytest.mark.parametrize(
    ("model", "prefix", "config"),
    [
        ("pi3", "encoder.", LARGE_WITH_REGISTERS),
        ("vggt", "aggregator.patch_embed.", LARGE_WITH_REGISTERS),
        ("dinov2-salad", "backbone.model.", BASE),
    ],
)
def test_keys_and_shapes_are_those_of_the_released_checkpoints(
    model: str, prefix: str, config: EncoderConfig
) -> None:
    with torch.device("meta"):
        ours = {key: list(value.shape) for key, value in Encoder(config).state_dict().items()}
    shapes = golden.load_manifest(model)["shapes"]
    theirs = {
        key.removeprefix(prefix).replace("patch_embed.patch_embed", "patch_embed"): shape
        for key, shape in shapes.items()
        if key.startswith(prefix) and not key.endswith("mask_token")
    }
    assert ours == theirs


@pytest.mark.parametrize("resampling", ["size", "factor"])
def test_positions_are_resampled_where_apples_gpus_may_be_unable_to(
    monkeypatch: pytest.MonkeyPatch, resampling: Literal["size", "factor"]
) -> None:
    """The meta device stands for one that is not here; only its way to the CPU must be made."""
    assert dinov2.UNABLE == {"mps"}
    monkeypatch.setattr(dinov2, "UNABLE", {"meta"})
    resampled_on, interpolate, move = [], functional.interpolate, Tensor.to

    def watch(maps: Tensor, **how: Any) -> Tensor:
        resampled_on.append(maps.device.type)
        return interpolate(maps, **how)

    def to(tensor: Tensor, *where: Any, **how: Any) -> Tensor:
        is_back = tensor.is_meta and where == ("cpu",)
        return torch.zeros(tensor.shape) if is_back else move(tensor, *where, **how)

    monkeypatch.setattr(functional, "interpolate", watch)
    monkeypatch.setattr(Tensor, "to", to)
    with torch.device("meta"):
        encoder = Encoder(replace(TINY, resampling=resampling))
    found = encoder.embed(torch.empty(1, 3, 28, 42, device="meta"))
    assert resampled_on == ["cpu"]
    assert found.device.type == "meta"
    assert found.shape == (1, 11, 64)


@pytest.mark.parametrize("how", ["weights", "autocast"])
def test_half_precision_stays_close(tiny: Encoder, how: str) -> None:
    """Eight bits of mantissa: 0.4 % each time, which adds up over the layers."""
    case = golden.load_case("mini/pi3", "a")
    expected = torch.from_numpy(case.expected["enc_out"])
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=how == "autocast"):
        encoder = filled(TINY, "encoder.").to(torch.bfloat16) if how == "weights" else tiny
        found = encoder(case.images).patches
    error = (found.float() - expected).abs().mean() / expected.abs().mean()
    assert 1e-4 < float(error) < 0.02


@torch.no_grad()
def test_images_of_a_batch_do_not_see_one_another(tiny: Encoder) -> None:
    images = golden.load_case("mini/pi3", "a").images
    alone = torch.cat([tiny(image[None]).patches for image in images])
    torch.testing.assert_close(tiny(images).patches, alone, rtol=0, atol=1e-6)


@torch.no_grad()
def test_the_image_token_is_the_first_and_registers_are_left_out(tiny: Encoder) -> None:
    images = golden.load_case("mini/pi3", "a").images
    out = tiny(images)
    assert out.image.shape == (3, 64)
    assert out.patches.shape == (3, 20, 64)
    assert tiny.embed(images).shape == (3, 1 + 4 + 20, 64)


def test_images_that_are_no_whole_patches_are_refused(tiny: Encoder) -> None:
    with pytest.raises(ValueError, match="70x60 px; sides must be multiples of 14"):
        tiny(torch.zeros(1, 3, 60, 70))


def tiny_tensors() -> dict[str, Tensor]:
    shapes = {key: list(value.shape) for key, value in Encoder(TINY).state_dict().items()}
    return golden.make_tensors(shapes)


def unfilled() -> Encoder:
    with torch.device("meta"):
        return Encoder(TINY)


def save(tensors: dict[str, Tensor], path: Path) -> Path:
    if path.suffix == ".safetensors":
        save_file(tensors, path)
    else:
        torch.save(tensors, path)
    return path


@pytest.mark.parametrize("name", ["tiny.safetensors", "tiny.pt", "tiny.ckpt"])
def test_weights_come_back_from_either_format(tmp_path: Path, name: str) -> None:
    tensors = tiny_tensors()
    encoder = unfilled()
    path = save(tensors | {"mask_token": torch.zeros(1, 64)}, tmp_path / name)
    load_weights(encoder, str(path), CHECKPOINT, unused=("mask_token", "not.there"))
    loaded = encoder.state_dict()
    assert loaded.keys() == tensors.keys()
    assert all(torch.equal(loaded[key], tensors[key]) for key in tensors)


def test_weights_may_be_kept_in_half_and_come_back_from_half(tmp_path: Path) -> None:
    tensors = tiny_tensors()
    path = save({key: value.half() for key, value in tensors.items()}, tmp_path / "half.pt")
    for dtype in (torch.float32, torch.bfloat16):
        encoder = unfilled()
        load_weights(encoder, str(path), CHECKPOINT, dtype=dtype)
        assert {value.dtype for value in encoder.state_dict().values()} == {dtype}


def test_weights_may_be_kept_in_half_in_part(tmp_path: Path) -> None:
    encoder = unfilled()
    path = save(tiny_tensors(), tmp_path / "tiny.pt")
    kinds = {True: torch.bfloat16, False: torch.float32}
    load_weights(encoder, str(path), CHECKPOINT, dtype=lambda key: kinds[key.startswith("blocks.")])
    loaded = encoder.state_dict()
    assert loaded["blocks.1.norm2.weight"].dtype == torch.bfloat16
    assert loaded["norm.weight"].dtype == torch.float32


def test_weights_below_the_name_of_a_training_framework_are_found(tmp_path: Path) -> None:
    path = tmp_path / "trained.ckpt"
    torch.save({"epoch": 3, "state_dict": tiny_tensors()}, path)
    encoder = unfilled()
    load_weights(encoder, str(path), CHECKPOINT)
    assert not next(encoder.parameters()).is_meta


def refusal(module: nn.Module, path: Path | str) -> str:
    with pytest.raises(WeightsError) as caught:
        load_weights(module, str(path), CHECKPOINT)
    message = str(caught.value)
    assert "\n" not in message
    assert "download tiny.pt (1 MB, CC0) from https://example.org/tiny.pt" in message
    return message


def test_a_missing_file_is_told_with_where_to_get_it(tmp_path: Path) -> None:
    assert "a.setting: not set;" in refusal(unfilled(), "")
    assert f"a.setting: no file '{tmp_path / 'gone.pt'}';" in refusal(
        unfilled(), tmp_path / "gone.pt"
    )


@pytest.mark.parametrize("name", ["other.pt", "other.safetensors"])
def test_weights_of_another_network_are_refused_by_their_keys(tmp_path: Path, name: str) -> None:
    tensors = tiny_tensors()
    tensors["norm.bias"] = torch.zeros(65)
    tensors["head.weight"] = torch.zeros(3)
    tensors["cls_token"] = torch.zeros(1, 1, 64, dtype=torch.int8)
    for key in [key for key in tensors if key.startswith("blocks.1.")]:
        del tensors[key]
    encoder = unfilled()
    message = refusal(encoder, save(tensors, tmp_path / name))
    assert f"{name} is no tiny.pt: 14 missing (blocks.1.norm1.weight, " in message
    assert ", ...), 1 unexpected (head.weight), " in message
    assert "1 of another shape (norm.bias (65,) for (64,))" in message
    assert "1 not floating (cls_token torch.int8)" in message
    assert len(message) < 500
    assert all(value.is_meta for value in encoder.state_dict().values())


@pytest.mark.parametrize("name", ["cut.pt", "cut.safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_file_that_was_cut_off_is_refused(tmp_path: Path, name: str, share: float) -> None:
    path = save(tiny_tensors(), tmp_path / name)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "is not read" in refusal(unfilled(), path)


def test_a_missing_reader_is_told_with_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save(tiny_tensors(), tmp_path / "tiny.safetensors")
    monkeypatch.setitem(sys.modules, "safetensors", None)
    with pytest.raises(DependencyError, match=r"needs safetensors .* 'laser-slam\[networks\]'"):
        load_weights(unfilled(), str(path), CHECKPOINT)


class Harmful:
    """What a pickle may do on loading; it must never come to that."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (Path("harm-done"),)  # type: ignore[return-value]


@pytest.mark.parametrize("content", [Harmful(), {"cls_token": Harmful()}, "text", {"epoch": 3}])
def test_nothing_but_tensors_is_unpickled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: object
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(content, tmp_path / "harm.pt")
    assert "is not read" in refusal(unfilled(), tmp_path / "harm.pt")
    assert not Path("harm-done").exists()
