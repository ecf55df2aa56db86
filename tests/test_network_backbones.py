"""Tiny networks with weights drawn from their names, as backbones: files, runs, refusals."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import golden
import numpy as np
import pytest
import torch
from corridor import Corridor
from numpy.typing import NDArray
from perfect import settings
from safetensors.torch import save_file
from torch import Tensor, nn

from laser_slam.backbones import BACKBONES, NETWORKS, make_backbone
from laser_slam.backbones.feedforward import NetworkBackbone
from laser_slam.backbones.pi3 import Pi3Backbone
from laser_slam.backbones.pi3x import Pi3XBackbone
from laser_slam.backbones.vggt import VggtBackbone
from laser_slam.camera import intrinsics_from_fov
from laser_slam.config import load_config
from laser_slam.errors import ConfigError, DependencyError, WeightsError
from laser_slam.networks.camera_head import CameraHeadConfig
from laser_slam.networks.dinov2 import EncoderConfig
from laser_slam.networks.dpt import DptConfig
from laser_slam.networks.metric import MetricConfig
from laser_slam.networks.pi3 import Pi3, Pi3Config, load_pi3
from laser_slam.networks.pi3x import Pi3X, Pi3XConfig
from laser_slam.networks.vggt import Vggt, VggtConfig
from laser_slam.pipeline import Pipeline
from laser_slam.store import load_prediction
from laser_slam.types import Image, WindowStatus

ENCODER = EncoderConfig(64, 2, 2, num_registers=4)
TINY = Pi3Config(ENCODER, depth=4, num_heads=2, head_depth=2, camera_width=32)
SIZE = (70, 126)
FRAMES = np.arange(3, 7)
K = intrinsics_from_fov(80.0, *SIZE)
GIVEN = "backbone.pi3.intrinsics=given"  # random weights agree on no camera


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Leave waiting threads out: what is computed here is tiny."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def filled(make: Callable[[], nn.Module]) -> Any:
    """Build a network and draw its weights from their names."""
    with torch.device("meta"):
        network = make()
    network.to_empty(device="cpu")
    golden.fill(network)
    return network.requires_grad_(requires_grad=False).eval()


def make_pi3x() -> nn.Module:
    return Pi3X(
        Pi3XConfig(
            ENCODER,
            depth=4,
            num_heads=2,
            head_depth=2,
            camera_width=32,
            depth_encoder=EncoderConfig(64, 2, 2, num_registers=4, channels=2),
            channels=(64, 32, 32),
            metric=MetricConfig(width=32, depth=1, num_heads=2),
            injected_after=(1,),
        )
    )


def make_vggt() -> nn.Module:
    shape = VggtConfig(
        ENCODER,
        depth=4,
        num_heads=2,
        levels=(0, 1, 2, 3),
        dense=DptConfig((16, 32, 64, 64), 32),
        camera=CameraHeadConfig(2, 2),
    )
    return Vggt(shape)


def images(count: int = len(FRAMES)) -> list[Image]:
    frames = golden.make_images(5, count, *SIZE)
    return [np.asarray(np.round(frame.transpose(1, 2, 0) * 255), np.uint8) for frame in frames]


@pytest.fixture(scope="module")
def pi3() -> Pi3:
    network: Pi3 = filled(lambda: Pi3(TINY))
    return network


def backbones(pi3: Pi3, *more: str) -> dict[str, NetworkBackbone]:
    config = settings(*more)
    return {
        "pi3": Pi3Backbone(config, pi3),
        "pi3x": Pi3XBackbone(config, filled(make_pi3x)),
        "vggt": VggtBackbone(config, filled(make_vggt)),
    }


# --- the networks themselves -------------------------------------------------------------------


def test_each_network_predicts_a_window(pi3: Pi3) -> None:
    given = [f"backbone.{name}.intrinsics=given" for name in NETWORKS]
    for backbone in backbones(pi3, *given).values():
        found = backbone.predict(images(), FRAMES, K)
        assert found.status is WindowStatus.OK
        assert found.depth.shape == (len(FRAMES), *SIZE)
        assert (found.confidence > 0).mean() > 0.99
        assert found.tokens is not None
        assert found.tokens.shape == (len(FRAMES), ENCODER.width)


def test_rays_without_a_camera_are_a_failed_window(pi3: Pi3) -> None:
    found = Pi3Backbone(settings(), pi3).predict(images(), FRAMES, K)
    assert found.status is WindowStatus.FAILED
    assert "no pinhole camera" in found.warnings[0]


def test_pi3s_numbers_are_those_of_its_network(pi3: Pi3) -> None:
    """The backbone adds no scale, no shift and no other order of frames."""
    found = Pi3Backbone(settings(GIVEN), pi3).predict(images(), FRAMES, K)
    batch = torch.from_numpy(np.stack(images())).permute(0, 3, 1, 2)[None] / 255
    with torch.no_grad():
        said = pi3(batch)
    np.testing.assert_allclose(found.depth, said.local_points[0, ..., 2].numpy(), rtol=1e-6)
    np.testing.assert_allclose(found.confidence, said.confidence[0].sigmoid().numpy(), rtol=1e-6)
    poses = said.window_from_cam[0].double().numpy()
    relative = np.linalg.inv(poses[0]) @ poses
    np.testing.assert_allclose(found.window_from_cam, relative, atol=1e-6)


def test_the_images_matter_and_their_order_is_kept(pi3: Pi3) -> None:
    backbone = Pi3Backbone(settings(GIVEN), pi3)
    forth = backbone.predict(images(), FRAMES, K)
    back = backbone.predict(images()[::-1], FRAMES, K)
    np.testing.assert_allclose(back.depth[::-1], forth.depth, rtol=1e-4)
    assert np.abs(back.depth - forth.depth).max() > 1e-3 * forth.depth.max()


def test_what_overflows_is_a_failed_window(pi3: Pi3) -> None:
    broken = filled(lambda: Pi3(TINY))
    broken.encoder.norm.weight.fill_(float("nan"))
    found = Pi3Backbone(settings(), broken).predict(images(), FRAMES, None)
    assert found.status is WindowStatus.FAILED
    assert "no finite depth" in found.warnings[0]


# --- files -------------------------------------------------------------------------------------


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


# --- a whole run -------------------------------------------------------------------------------


def test_a_tiny_network_maps_a_clip_and_tells_places_by_its_tokens(
    pi3: Pi3, tmp_path: Path
) -> None:
    """Nothing sensible can come of it, but everything must come through."""
    config = load_config(
        assignments=[
            *["windows.size=6", "windows.overlap=3", "windows.min_parallax_px=0"],
            *["places.descriptor=backbone", "run.samples=2"],
        ]
    )
    backbone = Pi3Backbone(settings(GIVEN), pi3)
    assert backbone.image_size((72, 128)) == SIZE
    results = Pipeline(Corridor(12), config, tmp_path / "run", backbone=backbone).run()
    assert len(results.trajectory.frames) == 12
    assert np.isfinite(results.trajectory.world_from_cam).all()
    assert (tmp_path / "run/pictures/similarity.png").exists()
    stored = sorted((tmp_path / "run/windows").glob("*.npz"))
    assert len(stored) == results.report["windows"]["num"] == 3
    tokens = [check_stored(file) for file in stored]
    np.testing.assert_array_equal(tokens[0][3:], tokens[1][:3])  # of the image alone


def check_stored(file: Path) -> NDArray[np.float32]:
    """Read a window back; return its tokens."""
    window, colors = load_prediction(file)
    assert colors.shape == (*window.depth.shape, 3)
    assert window.depth.shape[1:] == SIZE
    assert window.status is WindowStatus.OK
    assert window.tokens is not None
    assert window.tokens.shape == (len(window.frames), ENCODER.width)
    return window.tokens
