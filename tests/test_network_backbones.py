"""Tiny networks with weights drawn from their names, as backbones: files, runs, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from corridor import Corridor
from golden import filled
from numpy.typing import NDArray
from perfect import settings
from tiny import ENCODER, FRAMES, GIVEN, SIZE, TINY, K, images, make_pi3x, make_vggt

from laser_slam.backbones import NETWORKS, is_on_cpu
from laser_slam.backbones.feedforward import NetworkBackbone
from laser_slam.backbones.pi3 import Pi3Backbone
from laser_slam.backbones.pi3x import Pi3XBackbone
from laser_slam.backbones.vggt import VggtBackbone
from laser_slam.config import load_config
from laser_slam.networks.pi3 import Pi3
from laser_slam.pipeline import Pipeline
from laser_slam.store import load_prediction
from laser_slam.types import WindowStatus

pytestmark = pytest.mark.usefixtures("one_thread")


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


@pytest.mark.parametrize("name", [*sorted(NETWORKS), "depth_anything3"])
def test_a_network_that_is_to_compute_on_the_cpu_wants_no_gpu(name: str) -> None:
    for device, expected in {"cpu": True, "cpu:0": True, "cuda:1": False, "auto": False}.items():
        chosen = settings(f"backbone.name={name}", f"backbone.{name}.device={device}")
        assert is_on_cpu(chosen) is expected
    assert is_on_cpu(settings("backbone.name=classical"))
    other = settings("backbone.name=classical", f"backbone.{name}.device=cuda")
    assert is_on_cpu(other)  # its device matters when it is used only


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
