"""Weights from files, through a backbone: what predicts, and what is refused in one line."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from golden import filled
from perfect import settings
from safetensors.torch import save_file
from tiny import FRAMES, GIVEN, SIZE, TINY, K, images
from torch import Tensor

from laser_slam.backbones import BACKBONES, NETWORKS, make_backbone
from laser_slam.backbones.pi3 import Pi3Backbone
from laser_slam.backbones.vggt import VggtBackbone
from laser_slam.errors import ConfigError, DependencyError, WeightsError
from laser_slam.networks.pi3 import Pi3, load_pi3

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def pi3() -> Pi3:
    network: Pi3 = filled(lambda: Pi3(TINY))
    return network


@pytest.fixture
def tiny_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the backbone expect files of the tiny network."""
    monkeypatch.setattr("laser_slam.networks.pi3.load_pi3", partial(load_pi3, config=TINY))


def from_file(file: Path, *more: str) -> Pi3Backbone:
    return Pi3Backbone(settings(GIVEN, f"backbone.pi3.weights={file}", *more))


def write(file: Path, pi3: Pi3, **changes: Tensor | None) -> Path:
    """Write a file of the network's weights, some of them changed or left out."""
    tensors = {**pi3.state_dict(), **changes}
    kept = {key: value.clone() for key, value in tensors.items() if value is not None}
    save_file(kept, file) if file.suffix == ".safetensors" else torch.save(kept, file)
    return file


@pytest.mark.usefixtures("tiny_files")
@pytest.mark.parametrize("name", ["tiny.safetensors", "tiny.pt"])
def test_weights_of_a_file_predict_as_the_network_that_wrote_them(
    pi3: Pi3, tmp_path: Path, name: str
) -> None:
    file = write(tmp_path / name, pi3)
    found = from_file(file).predict(images(), FRAMES, K)
    expected = Pi3Backbone(settings(GIVEN), pi3).predict(images(), FRAMES, K)
    np.testing.assert_array_equal(found.depth, expected.depth)


@pytest.mark.usefixtures("tiny_files")
def test_identity_holds_the_hash_of_the_file(pi3: Pi3, tmp_path: Path) -> None:
    first = write(tmp_path / "a.safetensors", pi3)
    other = write(tmp_path / "b.safetensors", pi3, register_token=pi3.register_token + 1)
    same = first.rename(tmp_path / "c.safetensors")
    hashes = [from_file(file).identity()["checkpoint"] for file in (same, other, same)]
    assert hashes[0] == hashes[2] != hashes[1]


@pytest.mark.usefixtures("tiny_files")
def test_bfloat16_is_near_and_its_heads_are_exact(pi3: Pi3, tmp_path: Path) -> None:
    file = write(tmp_path / "tiny.pt", pi3)
    exact = from_file(file).predict(images(), FRAMES, K)
    near = from_file(file, "backbone.pi3.dtype=bfloat16").predict(images(), FRAMES, K)
    ratio = near.depth / exact.depth
    assert 1e-6 < np.abs(np.log(ratio)).mean() < 0.05


@pytest.mark.usefixtures("tiny_files")
@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        ({"register_token": None}, "1 missing (register_token)"),
        ({"register_token": torch.zeros(1, 1, 5, 63)}, "1 of another shape (register_token"),
        ({"register_token": torch.zeros(1, 1, 5, 64, dtype=torch.int64)}, "1 not floating"),
        (
            {"register_token": torch.zeros(1, 1, 5, 64).to(torch.float8_e4m3fn)},
            "1 not floating (register_token torch.float8_e4m3fn)",
        ),
        ({"another.head": torch.zeros(2)}, "1 unexpected (another.head)"),
    ],
)
def test_a_checkpoint_of_another_model_is_one_line(
    pi3: Pi3, tmp_path: Path, spoil: dict[str, Tensor | None], why: str
) -> None:
    file = write(tmp_path / "other.safetensors", pi3, **spoil)
    with pytest.raises(WeightsError) as caught:
        from_file(file).predict(images(), FRAMES, K)
    text = str(caught.value)
    assert f"{file} is no model.safetensors: {why}" in text
    assert "backbone.pi3.weights" in text
    assert "\n" not in text


@pytest.mark.usefixtures("tiny_files")
@pytest.mark.parametrize("name", ["cut.safetensors", "cut.pt"])
def test_a_truncated_checkpoint_is_one_line(pi3: Pi3, tmp_path: Path, name: str) -> None:
    file = write(tmp_path / name, pi3)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(WeightsError, match=r"cut\..* is not read"):
        from_file(file).predict(images(), FRAMES, K)


@pytest.mark.usefixtures("tiny_files")
def test_a_table_whose_keys_are_no_names_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "numbered.pt"
    torch.save({0: torch.zeros(2)}, file)
    with pytest.raises(WeightsError, match=r"numbered\.pt is not read.* no table of tensors"):
        from_file(file).predict(images(), FRAMES, K)


def test_a_checkpoint_of_the_wrong_size_is_no_released_one(pi3: Pi3, tmp_path: Path) -> None:
    file = write(tmp_path / "tiny.safetensors", pi3)
    with pytest.raises(WeightsError, match="of another shape"):
        from_file(file).predict(images(), FRAMES, K)


def test_missing_weights_are_told_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"backbone\.pi3\.weights: no file"):
        from_file(tmp_path / "nowhere.safetensors")


def test_a_missing_device_is_told_before_anything_is_read() -> None:
    with pytest.raises(ConfigError, match=r"backbone\.vggt\.device: no 'tpu' here"):
        VggtBackbone(settings("backbone.vggt.device=tpu"))


def test_without_pytorch_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise DependencyError("PyTorch cannot be loaded")

    monkeypatch.setattr("laser_slam.backbones.feedforward.backbone.import_torch", missing)
    with pytest.raises(DependencyError, match="PyTorch cannot be loaded"):
        Pi3Backbone(settings())


@pytest.mark.usefixtures("tiny_files")
def test_the_settings_name_the_backbone(pi3: Pi3, tmp_path: Path) -> None:
    file = write(tmp_path / "tiny.safetensors", pi3)
    config = settings("backbone.name=pi3", f"backbone.pi3.weights={file}", "backbone.pi3.chunk=2")
    backbone = make_backbone(config)
    assert isinstance(backbone, Pi3Backbone)
    assert NETWORKS < set(BACKBONES)
    assert not backbone.remembers
    assert backbone.sees_far_frames
    assert backbone.predict(images(), FRAMES, None).depth.shape == (len(FRAMES), *SIZE)
