"""Backbones that are networks: the truth, said as each of them says it, comes back as the truth."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from corridor import Corridor, true_intrinsics, view
from numpy.typing import NDArray
from perfect import CONFIDENCE, SIZE, Knowing, PerfectPi3, camera, seen, settings

from laser_slam.backbones.feedforward import View, to_prediction
from laser_slam.backbones.pi3 import Pi3Backbone
from laser_slam.camera import resize_intrinsics
from laser_slam.config import load_config
from laser_slam.errors import ConfigError, DegenerateGeometryError
from laser_slam.pipeline import Pipeline
from laser_slam.rectification import resize_image
from laser_slam.sim3 import Array, rotation_exp, rotation_log, umeyama
from laser_slam.types import Prediction, Window, WindowStatus

NAMES = ["pi3", "pi3x", "vggt"]
FRAMES = np.arange(40, 49)
CENTRE = ((SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2)


def images(frames: NDArray[np.int64] = FRAMES) -> list[Any]:
    return [resize_image(view(int(frame))[0], SIZE) for frame in frames]


def predict(name: str, *more: str, intrinsics: Array | None = None) -> Prediction:
    return Knowing(name, *more).predict(images(), FRAMES, intrinsics)


def check_truth(found: Prediction, K: Array) -> None:
    """Hold depth, motion and camera against the corridor's, in one unit for all."""
    depth, world_from_cam = seen(FRAMES, K)
    unit_m = np.median(depth / found.depth)
    np.testing.assert_allclose(found.depth * unit_m, depth, rtol=2e-5)
    np.testing.assert_allclose(found.intrinsics, np.tile(K, (len(FRAMES), 1, 1)), rtol=1e-4)
    first_from_cam = np.linalg.inv(world_from_cam[0]) @ world_from_cam
    turn = found.window_from_cam[:, :3, :3].transpose(0, 2, 1) @ first_from_cam[:, :3, :3]
    assert np.abs(rotation_log(turn)).max() < 1e-5
    np.testing.assert_allclose(
        found.window_from_cam[:, :3, 3] * unit_m, first_from_cam[:, :3, 3], atol=1e-4
    )


@pytest.mark.parametrize("name", NAMES)
def test_the_truth_in_a_networks_own_terms_comes_back_as_the_truth(name: str) -> None:
    found = predict(name)
    centre = (SIZE[1] / 2, SIZE[0] / 2) if name == "vggt" else CENTRE
    check_truth(found, camera(centre))
    assert found.status is WindowStatus.OK
    assert found.warnings == ()
    np.testing.assert_allclose(found.confidence, CONFIDENCE, rtol=1e-5)
    np.testing.assert_array_equal(found.window_from_cam[0], np.eye(4))
    products = found.window_from_cam[:, :3, :3] @ found.window_from_cam[:, :3, :3].swapaxes(1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (len(FRAMES), 1, 1)), atol=1e-13)
    assert found.tokens is not None
    assert found.tokens.shape == (len(FRAMES), 32)
    assert found.tokens.dtype == np.float32


def test_pi3x_is_told_of_a_camera_and_answers_about_its_principal_point_in_metres() -> None:
    K = camera((58.0, 40.0))
    knowing = Knowing("pi3x")
    found = knowing.predict(images(), FRAMES, K)
    assert knowing.network.told is not None
    assert knowing.network.told.intrinsics is not None
    told = knowing.network.told.intrinsics
    assert told.shape == (1, len(FRAMES), 3, 3)
    np.testing.assert_allclose(told[0, 3].numpy(), K, rtol=1e-6)
    check_truth(found, K)
    np.testing.assert_allclose(found.depth, seen(FRAMES, K)[0], rtol=2e-5)


def test_pi3x_that_is_not_to_be_told_is_not() -> None:
    knowing = Knowing("pi3x", "backbone.pi3x.told_intrinsics=false")
    check_truth(knowing.predict(images(), FRAMES, camera((58.0, 40.0))), camera(CENTRE))
    assert knowing.network.told is None
    assert knowing.identity()["told_intrinsics"] is False


@pytest.mark.parametrize("name", NAMES)
def test_given_intrinsics_are_taken_where_the_settings_say_so(name: str) -> None:
    K = camera((60.0, 36.0)) * 1.25
    K[2, 2] = 1
    found = predict(name, f"backbone.{name}.intrinsics=given", intrinsics=K)
    np.testing.assert_array_equal(found.intrinsics, np.tile(K, (len(FRAMES), 1, 1)))
    with pytest.raises(ConfigError, match=rf"backbone\.{name}\.intrinsics: 'given', but .* has no"):
        predict(name, f"backbone.{name}.intrinsics=given")


@pytest.mark.parametrize("name", NAMES)
def test_a_whole_run_over_perfect_predictions_ends_at_the_truth(name: str, tmp_path: Path) -> None:
    config = load_config(
        assignments=[
            *["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"],
            *["closures.enabled=false", "run.samples=1"],
        ]
    )
    dataset = Corridor(30, with_intrinsics=False)
    results = Pipeline(dataset, config, tmp_path / "run", backbone=Knowing(name)).run()
    truth = dataset.info.truth
    assert truth is not None
    found, true = results.trajectory.world_from_cam[:, :3, 3], truth.world_from_cam[:, :3, 3]
    error = umeyama(found, true).apply(found) - true
    # The corridor is rendered at pixels' centres; files keep depth to five parts in ten thousand.
    assert np.sqrt((error**2).sum(axis=1).mean()) < 3e-3
    assert results.report["windows"]["bridged"] == {}


# --- wild numbers ------------------------------------------------------------------------------


def wild_view(**changes: Any) -> View:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = rotation_exp(0.1 * rng.normal(size=(4, 3)))
    poses[:, 2, 3] = np.arange(4)
    fields = {
        "depth": rng.uniform(1, 5, (4, *SIZE)).astype(np.float32),
        "confidence": np.full((4, *SIZE), 0.5, np.float32),
        "window_from_cam": poses,
        "intrinsics": camera(CENTRE),
        "tokens": rng.normal(size=(4, 8)).astype(np.float32),
    }
    return View(**{**fields, **changes})


def test_depth_that_cannot_be_is_unknown() -> None:
    good = wild_view()
    for row, value in enumerate([np.nan, np.inf, -np.inf, -1.0, 0.0]):
        good.depth[0, row] = value
    good.confidence[1, 0] = np.nan
    good.confidence[1, 1] = 0
    good.confidence[2, 0] = 1.0000001
    found = to_prediction(good, np.arange(4))
    assert np.isnan(found.depth[0, :5]).all()
    assert (found.confidence[0, :5] == 0).all()
    assert np.isnan(found.depth[1, :2]).all()
    assert found.confidence[2, 0].max() == 1
    np.testing.assert_array_equal(found.depth[3], good.depth[3])
    assert found.status is WindowStatus.OK


def test_a_frame_without_pose_is_put_between_its_neighbours_and_its_depth_is_unknown() -> None:
    broken = wild_view()
    broken.window_from_cam[2, 0, 0] = np.nan
    found = to_prediction(broken, np.array([3, 4, 5, 9]))
    assert found.warnings == ("the network gives no finite pose of 1 frames (5): interpolated",)
    assert np.isnan(found.depth[2]).all()
    assert np.isfinite(found.depth[[0, 1, 3]]).all()
    centres = found.window_from_cam[:, :3, 3]
    between = centres[1] + (centres[3] - centres[1]) / 5
    np.testing.assert_allclose(centres[2], between, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"depth": np.full((4, *SIZE), np.nan)}, "no finite depth"),
        ({"confidence": np.zeros((4, *SIZE))}, "no finite depth"),
        ({"window_from_cam": np.full((4, 4, 4), np.nan)}, "no finite depth and pose"),
        ({"intrinsics": None}, "no pinhole camera"),
    ],
)
def test_nothing_finite_is_a_failed_window_with_a_warning(changes: Any, why: str) -> None:
    found = to_prediction(wild_view(**changes), np.arange(4))
    assert found.status is WindowStatus.FAILED
    assert why in found.warnings[0]
    assert np.isnan(found.depth).all()
    assert (found.confidence == 0).all()


def test_wild_tokens_become_zeros_and_the_window_stays() -> None:
    view_ = wild_view()
    assert view_.tokens is not None
    view_.tokens[1, 2] = np.inf
    found = to_prediction(view_, np.arange(4))
    assert found.tokens is not None
    assert (found.tokens[1] == 0).all()
    np.testing.assert_array_equal(found.tokens[3], view_.tokens[3])


# --- what a backbone says of itself ------------------------------------------------------------


def test_calibration_is_what_was_given_and_says_so() -> None:
    backbone = Knowing("pi3")
    window = Window(0, FRAMES, tuple(images()))
    K = resize_intrinsics(true_intrinsics(), (72, 128), SIZE)
    given = backbone.calibrate([window], K)
    assert given.intrinsics is K
    assert given.size == SIZE
    assert not given.distortion.any()
    assert (
        given.source
        == "given, and taken to be free of distortion; pi3 sees with a camera of its own"
    )
    assert backbone.calibrate(iter([window]), None).source.startswith("unknown, ")
    with pytest.raises(DegenerateGeometryError, match="no window"):
        backbone.calibrate([], K)


@pytest.mark.parametrize("name", NAMES)
def test_identity_tells_apart_what_predicts_otherwise_and_nothing_else(name: str) -> None:
    def of(*more: str) -> dict[str, Any]:
        return dict(Knowing(name, *more).identity())

    plain = of()
    assert plain["network"] == name
    assert plain["size"] == {"side": 126}
    assert len(plain["checkpoint"]) == len(hashlib.sha256().hexdigest())
    for same in ("device=auto", "chunk=3", "num_pixels=10000"):
        assert of(f"backbone.{name}.{same}") == plain
    others = ("dtype=bfloat16", "side=140", "size_rule=pixels", "intrinsics=given")
    assert len({str(of(f"backbone.{name}.{other}")) for other in others} | {str(plain)}) == 5


def test_too_little_memory_is_one_line_that_says_what_to_lower() -> None:
    class Greedy(PerfectPi3):
        def __call__(self, images: Any) -> Any:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    backbone = Pi3Backbone(settings(), Greedy())  # type: ignore[arg-type]
    with pytest.raises(ConfigError) as caught:
        backbone.predict(images(), FRAMES, None)
    text = str(caught.value)
    assert text.startswith("no memory for 9 frames of 126x70, about 0.0 GB of ")
    assert text.endswith(": lower windows.size to 6 (or auto), or lower backbone.pi3.side to 98")
    assert "\n" not in text


def test_weights_that_do_not_fit_on_the_device_are_one_line() -> None:
    class Heavy(PerfectPi3):
        def to(self, device: torch.device) -> Any:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    backbone = Pi3Backbone(settings(), Heavy())  # type: ignore[arg-type]
    expected = "no memory for the weights of pi3 on cpu, 3.8 GB: set backbone.pi3.dtype=bfloat16"
    with pytest.raises(ConfigError, match=expected):
        backbone.predict(images(), FRAMES, None)


def test_another_error_of_the_network_stays_what_it_is() -> None:
    class Broken(PerfectPi3):
        def __call__(self, images: Any) -> Any:
            raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="mat1 and mat2"):
        Pi3Backbone(settings(), Broken()).predict(images(), FRAMES, None)  # type: ignore[arg-type]
