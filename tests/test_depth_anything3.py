"""The adapter of another's package, against a stand-in with that package's interface."""

import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import huggingface_hub
import numpy as np
import pytest
import torch
from corridor import view
from numpy.typing import NDArray
from perfect import CONFIDENCE, SIZE, camera, seen

from laser_slam.backbones import make_backbone
from laser_slam.config import DeviceConfig, load_config
from laser_slam.config.backbones import BackboneConfig
from laser_slam.errors import ConfigError, DependencyError, WeightsError
from laser_slam.rectification import resize_image
from laser_slam.sim3 import rotation_log
from laser_slam.types import Prediction, WindowStatus

FRAMES = np.arange(20, 26)
UNIT_M = 3.5
K = camera((SIZE[1] / 2, SIZE[0] / 2))


@dataclass
class Answer:
    """What the package's ``inference`` returns, as far as it matters here."""

    depth: Any
    conf: Any
    extrinsics: Any
    intrinsics: Any


class StandIn:
    """A model that knows the corridor; world-to-camera poses of three rows, as the package's."""

    has_poses = True
    rows = 3
    read: ClassVar[list[tuple[str, str | None]]] = []

    @classmethod
    def from_pretrained(cls, name: str, *, revision: str | None = None) -> "StandIn":
        if name == "nobody/nothing":
            raise OSError("nobody/nothing is not a local folder\nand is not a valid model")
        cls.read.append((name, revision))
        return cls()

    def to(self, device: torch.device) -> "StandIn":
        self.device = device
        return self

    def eval(self) -> "StandIn":
        return self

    def inference(self, image: list[NDArray[np.uint8]], process_res: int = 504) -> Answer:
        assert all(one.shape == (*SIZE, 3) for one in image)
        assert process_res == max(SIZE)
        depth, world_from_cam = seen(FRAMES, K)
        cam_from_world = np.linalg.inv(world_from_cam)
        cam_from_world[:, :3, 3] /= UNIT_M
        if not self.has_poses:
            return Answer(depth, None, None, None)
        return Answer(
            (depth / UNIT_M).astype(np.float32),
            np.full(depth.shape, 1 / (1 - CONFIDENCE), np.float32),
            cam_from_world[:, : self.rows].astype(np.float32),
            np.tile(K, (len(FRAMES), 1, 1)).astype(np.float32),
        )


@pytest.fixture(autouse=True)
def _installed(monkeypatch: pytest.MonkeyPatch) -> None:
    package, api = ModuleType("depth_anything_3"), ModuleType("depth_anything_3.api")
    api.DepthAnything3 = StandIn  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "depth_anything_3", package)
    monkeypatch.setitem(sys.modules, "depth_anything_3.api", api)
    monkeypatch.setattr(StandIn, "read", [])

    def download(repo: str, file: str, *, local_files_only: bool = False) -> str:
        if local_files_only and repo == "somebody/new":
            raise FileNotFoundError("not in the cache")
        return f"/cache/{repo}/snapshots/{'abc' if local_files_only else 'newest'}/{file}"

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)


def settings(*more: str) -> BackboneConfig:
    chosen = ["backbone.name=depth_anything3", "backbone.depth_anything3.side=126"]
    return load_config(assignments=[*chosen, *more]).backbone


def predict(*more: str) -> Prediction:
    images = [resize_image(view(int(frame))[0], SIZE) for frame in FRAMES]
    return make_backbone(settings(*more)).predict(images, FRAMES, None)


@pytest.mark.parametrize("rows", [3, 4])
def test_the_truth_in_the_packages_terms_comes_back_as_the_truth(
    monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    monkeypatch.setattr(StandIn, "rows", rows)
    found = predict()
    depth, world_from_cam = seen(FRAMES, K)
    assert found.status is WindowStatus.OK
    np.testing.assert_allclose(found.depth * UNIT_M, depth, rtol=1e-5)
    np.testing.assert_allclose(found.confidence, CONFIDENCE, rtol=1e-5)
    np.testing.assert_allclose(found.intrinsics[2], K, rtol=1e-6)
    relative = np.linalg.inv(world_from_cam[0]) @ world_from_cam
    turn = found.window_from_cam[:, :3, :3].transpose(0, 2, 1) @ relative[:, :3, :3]
    assert np.abs(rotation_log(turn)).max() < 1e-5
    np.testing.assert_allclose(
        found.window_from_cam[:, :3, 3] * UNIT_M, relative[:, :3, 3], atol=1e-4
    )


def test_images_arrive_at_the_size_that_the_package_would_make_of_them() -> None:
    backbone = make_backbone(settings("backbone.depth_anything3.side=504"))
    assert backbone.image_size((376, 1241)) == (154, 504)
    assert backbone.image_size((480, 640)) == (378, 504)
    assert backbone.identity()["model"] == "depth-anything/DA3-BASE"
    assert backbone.sees_far_frames
    assert not backbone.remembers


def test_the_model_is_read_when_the_first_window_is_predicted() -> None:
    backbone = make_backbone(settings())
    backbone.identity()
    assert not StandIn.read
    images = [np.zeros((*SIZE, 3), np.uint8)] * len(FRAMES)
    for _ in range(2):
        backbone.predict(images, FRAMES, None)
    assert StandIn.read == [("depth-anything/DA3-BASE", "abc")]


def test_identity_tells_model_revision_package_and_dtype(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def identity(*more: str) -> dict[str, Any]:
        return make_backbone(settings(*more)).identity()

    known = identity()
    assert known["revision"] == "abc"
    assert known["package"] == "unknown"
    assert identity("backbone.depth_anything3.model=somebody/new")["revision"] == "newest"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: True)
    on_cpu = identity("backbone.depth_anything3.device=cpu")
    assert (known["dtype"], on_cpu["dtype"]) == ("float16", "bfloat16")
    info = tmp_path / "depth_anything_3-0.0.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: depth-anything-3\nVersion: 0.0.0\n"
    )
    (info / "direct_url.json").write_text('{"url": "u", "vcs_info": {"commit_id": "f00d"}}')
    monkeypatch.syspath_prepend(str(tmp_path))
    assert identity("backbone.depth_anything3.device=cpu")["package"] == "0.0.0 f00d"


def test_of_a_folder_the_file_itself_tells_the_revision(tmp_path: Path) -> None:
    revisions = []
    for content in (b"one", b"other"):
        (tmp_path / "model.safetensors").write_bytes(content)
        backbone = make_backbone(settings(f"backbone.depth_anything3.model={tmp_path}"))
        revisions.append(backbone.identity()["revision"])
    assert len(set(revisions)) == 2
    predict(f"backbone.depth_anything3.model={tmp_path}")
    assert StandIn.read == [(str(tmp_path), None)]
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(WeightsError, match=r"cannot be had .*model\.safetensors'\); give a folder"):
        predict(f"backbone.depth_anything3.model={tmp_path}")


def test_its_settings_have_a_device_as_those_of_all_networks() -> None:
    """So that a machine that does not predict can ask for none."""
    assert isinstance(settings().depth_anything3, DeviceConfig)
    assert isinstance(settings().pi3x, DeviceConfig)


def test_a_model_without_poses_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StandIn, "has_poses", False)
    with pytest.raises(WeightsError, match=r"depth_anything3\.model: .* gives no poses; take one"):
        predict()


def test_without_the_package_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depth_anything_3.api", None)
    with pytest.raises(
        DependencyError, match=r"needs its authors' package .* pip install git"
    ) as e:
        make_backbone(settings())
    assert "\n" not in str(e.value)


def test_a_device_that_is_not_there_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"backbone\.depth_anything3\.device: no 'tpu' here"):
        make_backbone(settings("backbone.depth_anything3.device=tpu"))


def test_a_model_that_cannot_be_had_is_one_line() -> None:
    with pytest.raises(WeightsError) as caught:
        predict("backbone.depth_anything3.model=nobody/nothing")
    assert "'nobody/nothing' cannot be had (nobody/nothing is not a local folder)" in str(
        caught.value
    )
    assert "\n" not in str(caught.value)
