"""What the frames of a window say of each other's depth: noise and moving things go."""

from dataclasses import replace

import numpy as np
import pytest

from laser_slam.camera import intrinsics_from_fov, rays
from laser_slam.config import FusionConfig
from laser_slam.fusion.consistency import consistent_depth
from laser_slam.types import Prediction

SIZE = (30, 60)
NUM, WALL, STEP = 9, 8.0, 0.2
CONFIG = FusionConfig(agreement=0.03, min_agreeing=1)


def drive(*, unit: float = 1.0) -> Prediction:
    """Drive straight at a wall between a road and a ceiling, both 1.5 from the camera."""
    intrinsics = intrinsics_from_fov(70, *SIZE)
    window_from_cam = np.tile(np.eye(4), (NUM, 1, 1))
    window_from_cam[:, 2, 3] = unit * STEP * np.arange(NUM)
    down = np.abs(rays(intrinsics, *SIZE)[..., 1])
    depth = np.stack([np.minimum(1.5 / down, WALL - STEP * i) for i in range(NUM)])
    return Prediction(
        frames=np.arange(NUM),
        depth=(unit * depth).astype(np.float32),
        confidence=np.ones((NUM, *SIZE), np.float32),
        window_from_cam=window_from_cam,
        intrinsics=np.tile(intrinsics, (NUM, 1, 1)),
    )


def with_depth(prediction: Prediction, depth: np.ndarray) -> Prediction:
    known = np.isfinite(depth)
    confidence = np.where(known, prediction.confidence, 0).astype(np.float32)
    return replace(prediction, depth=depth.astype(np.float32), confidence=confidence)


def ask(
    prediction: Prediction, row: int, config: FusionConfig = CONFIG
) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth of a frame, and where its pixels stay."""
    weight = prediction.confidence[row].copy()
    depth = consistent_depth(prediction, row, weight, config)
    return depth, weight > 0


@pytest.mark.parametrize("row", [0, 4, NUM - 1])
def test_a_still_scene_stays_as_it_is(row: int) -> None:
    prediction = drive()
    depth, stays = ask(prediction, row)
    inside = (slice(3, -3), slice(6, -6))  # the first frame alone has seen its border
    assert stays[inside].mean() > 0.99
    assert stays.mean() > (0.99 if row else 0.85)
    ratio = depth[stays] / prediction.depth[row][stays]
    assert abs(np.log(ratio)).max() < 0.03
    assert abs(np.median(ratio) - 1) < 0.001


def test_noise_is_averaged_away() -> None:
    prediction, rng = drive(), np.random.default_rng(0)
    noisy = with_depth(prediction, prediction.depth * np.exp(0.01 * rng.normal(size=(NUM, *SIZE))))
    depth, stays = ask(noisy, 4)
    wall = prediction.depth[4] > 0.99 * prediction.depth[4].max()
    before = np.std(noisy.depth[4][wall & stays])
    after = np.std(depth[wall & stays])
    assert stays.mean() > 0.95
    assert after < before / np.sqrt(7) * 1.3  # the frame and six others, some of them cut off


def test_flying_pixels_go_and_what_was_right_stays() -> None:
    prediction, rng = drive(), np.random.default_rng(0)
    flies = rng.random((NUM, *SIZE)) < 0.1
    depth = np.where(flies, prediction.depth * rng.uniform(0.4, 0.9, flies.shape), prediction.depth)
    _, stays = ask(with_depth(prediction, depth), 4)
    assert stays[flies[4]].mean() < 0.05
    assert stays[~flies[4]].mean() > 0.99


@pytest.mark.parametrize("speed", [-0.4, 0.2, 0.5])
def test_a_car_that_drives_before_the_camera_goes(speed: float) -> None:
    """With the camera's own speed its depth stays the same, and no pixel of it moves."""
    prediction = drive()
    depth = prediction.depth.copy()
    for i in range(NUM):
        depth[i, 12:18, 24:36] = 4.0 + (speed - STEP) * (i - 4)
    _, stays = ask(with_depth(prediction, depth), 4)
    assert stays[12:18, 24:36].mean() < 0.05
    assert stays[:12].mean() > 0.95
    still = prediction.depth.copy()
    for i in range(NUM):
        still[i, 12:18, 24:36] = 4.0 - STEP * (i - 4)
    _, stays = ask(with_depth(prediction, still), 4)
    assert stays[13:17, 26:34].all()


def test_what_only_one_frame_saw_stays_only_where_nobody_is_asked() -> None:
    prediction = drive()
    lonely = prediction.depth.copy()
    lonely[[i for i in range(NUM) if i != 4]] = np.nan
    assert not ask(with_depth(prediction, lonely), 4)[1].any()
    for changes in ({"agreement": 0.0}, {"min_agreeing": 0}):
        depth, stays = ask(with_depth(prediction, lonely), 4, CONFIG.model_copy(update=changes))
        assert stays.all()
        np.testing.assert_array_equal(depth, prediction.depth[4])


def test_a_window_of_one_frame_stays_as_it_is() -> None:
    prediction = drive()
    single = Prediction(
        prediction.frames[:1],
        prediction.depth[:1],
        prediction.confidence[:1],
        prediction.window_from_cam[:1],
        prediction.intrinsics[:1],
    )
    depth, stays = ask(single, 0)
    assert stays.all()
    np.testing.assert_array_equal(depth, prediction.depth[0])


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_the_unit_of_the_window_decides_nothing(unit: float) -> None:
    rng = np.random.default_rng(2)
    factor = np.exp(0.03 * rng.normal(size=(NUM, *SIZE)))
    one, other = (with_depth(p, p.depth * factor) for p in (drive(), drive(unit=unit)))
    (depth, stays), (same_depth, same_stays) = ask(one, 4), ask(other, 4)
    assert 0.01 < 1 - stays.mean() < 0.9
    assert (stays == same_stays).mean() > 0.998  # rounding at pixels' borders
    both = stays & same_stays
    np.testing.assert_allclose(unit * depth[both], same_depth[both], rtol=0.01)


def test_the_prediction_is_not_changed() -> None:
    prediction = drive()
    before = prediction.depth.copy()
    ask(prediction, 4)
    np.testing.assert_array_equal(prediction.depth, before)
