"""The default backbone on a rendered drive, and on all that a drive should not be."""

import logging
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from quick_runs import leave_pictures_out
from rendered import RenderedDrive
from tracks import Drive

from laser_slam.backbones.base import Backbone
from laser_slam.backbones.classical import ClassicalBackbone
from laser_slam.backbones.classical.prediction import follow_turn, without_depth
from laser_slam.camera import intrinsics_matrix, resize_intrinsics
from laser_slam.config import BackboneConfig, ClassicalConfig, Config
from laser_slam.pipeline import Pipeline
from laser_slam.sim3 import Array, Sim3, rotation_exp, rotation_log, umeyama
from laser_slam.slam import Slam
from laser_slam.types import Frame, Image, Prediction, SequenceInfo, WindowStatus

SIZE = 12
SMALL = (96, 320)
FAST = ClassicalConfig(depth_width=128, num_planes=32)


def backbone(config: ClassicalConfig = FAST) -> ClassicalBackbone:
    return ClassicalBackbone(BackboneConfig(classical=config))


def predict(
    images: Sequence[Image],
    K: Array | None,
    start: int = 0,
    using: ClassicalBackbone | None = None,
) -> Prediction:
    return (using or backbone()).predict(images, np.arange(start, start + len(images)), K)


def noisy(image: Image, sigma: float = 2.0, seed: int = 0) -> Image:
    noise = np.random.default_rng(seed).normal(0, sigma, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def copies(image: Image, num: int, sigma: float = 2.0) -> list[Image]:
    return [noisy(image, sigma, seed) for seed in range(num)]


def blank(image: Image, num: int) -> list[Image]:
    return [np.full_like(image, 90)] * num


def mirrored(images: Sequence[Image]) -> list[Image]:
    return [np.ascontiguousarray(image[:, ::-1]) for image in images]


def world_from_window(window: Prediction, world_from_cam: Array) -> Sim3:
    return umeyama(window.window_from_cam[:, :3, 3], world_from_cam[:, :3, 3])


def position_error(window: Prediction, world_from_cam: Array) -> float:
    """Return the root mean square distance after a Sim(3), over the length of the path."""
    truth = world_from_cam[:, :3, 3]
    placed = world_from_window(window, world_from_cam).apply(window.window_from_cam[:, :3, 3])
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(np.sqrt(((placed - truth) ** 2).sum(axis=1).mean()) / path)


def rotation_error_deg(window: Prediction, first_from_cam: Array) -> float:
    """Return the largest angle to (N, 3, 3) true rotations, both from the first camera."""
    gap = first_from_cam.transpose(0, 2, 1) @ window.window_from_cam[:, :3, :3]
    return float(np.degrees(np.linalg.norm(rotation_log(gap), axis=1)).max())


def relative_depth(window: Prediction, drive: RenderedDrive, frames: slice) -> NDArray[np.float64]:
    """Return the error of each depth over the true one; sky counts as infinitely far."""
    size = window.depth.shape[:0:-1]
    truth = [cv2.resize(d, size, interpolation=cv2.INTER_NEAREST) for d in drive.depths[frames]]
    scale = world_from_window(window, drive.world_from_cam[frames]).scale
    error = np.abs(window.depth * scale / np.stack(truth) - 1)
    return np.where(np.isfinite(truth), error, 1.0)


def assert_says_nothing_of_depth(window: Prediction, status: WindowStatus) -> None:
    assert window.status is status
    assert np.isnan(window.depth).all()
    assert not window.confidence.any()
    assert not window.window_from_cam[:, :3, 3].any()


def resized(
    drive: RenderedDrive, width: int, height: int, columns: slice = slice(0, 640)
) -> tuple[list[Image], Array]:
    """Cut out columns and resize; returns images and their intrinsics."""
    size = (width, height)
    images = [
        np.asarray(cv2.resize(image[:, columns], size, interpolation=cv2.INTER_AREA))
        for image in drive.images
    ]
    K = drive.intrinsics.copy()
    K[0, 2] -= columns.start
    return images, resize_intrinsics(K, (192, columns.stop - columns.start), (height, width))


@pytest.fixture(scope="module")
def small_drive(short_drive: RenderedDrive) -> RenderedDrive:
    """The same drive at half the size, where size does not matter."""
    images, K = resized(short_drive, SMALL[1], SMALL[0])
    return replace(short_drive, images=images, intrinsics=K)


@dataclass(frozen=True)
class TwoWindows:
    """Windows that share four frames, at the default settings."""

    first: Prediction
    second: Prediction


@pytest.fixture(scope="module")
def windows(short_drive: RenderedDrive) -> TwoWindows:
    using = backbone(ClassicalConfig())
    first = predict(short_drive.images[:SIZE], short_drive.intrinsics, 0, using)
    second = predict(short_drive.images[8:20], short_drive.intrinsics, 8, using)
    return TwoWindows(first, second)


def test_a_window_of_a_drive_is_whole(windows: TwoWindows) -> None:
    for window in (windows.first, windows.second):
        assert window.status is WindowStatus.OK
        assert window.warnings == ()
        assert window.depth.shape == window.confidence.shape == (SIZE, 192, 640)
        assert np.array_equal(np.isnan(window.depth), window.confidence == 0)
        assert (window.depth[window.confidence > 0] > 0).all()
        np.testing.assert_allclose(window.window_from_cam[0], np.eye(4), atol=1e-12)
        assert 0.5 < np.nanmedian(window.depth) < 2
    assert windows.second.frames.tolist() == list(range(8, 20))


def test_poses_are_those_of_the_drive(windows: TwoWindows, short_drive: RenderedDrive) -> None:
    for window, frames in ((windows.first, slice(0, 12)), (windows.second, slice(8, 20))):
        truth = short_drive.world_from_cam[frames]
        assert position_error(window, truth) < 0.001
        first_from_cam = truth[0, :3, :3].T @ truth[:, :3, :3]
        assert rotation_error_deg(window, first_from_cam) < 0.05


def test_confidence_is_honest(windows: TwoWindows, short_drive: RenderedDrive) -> None:
    for window, frames in ((windows.first, slice(0, 12)), (windows.second, slice(8, 20))):
        is_confident = window.confidence > 0.5
        error = relative_depth(window, short_drive, frames)[is_confident]
        assert is_confident.mean() > 0.45
        assert (error < 0.1).mean() > 0.9
        assert error.mean() < 0.05


def test_the_sky_is_unknown_but_for_its_very_edge(
    windows: TwoWindows, short_drive: RenderedDrive
) -> None:
    is_sky = ~np.isfinite(short_drive.depths[:SIZE])
    confidence = windows.first.confidence
    assert is_sky.mean() > 0.05
    assert (confidence[is_sky] > 0.5).mean() < 0.03
    inner = cv2.erode(is_sky.transpose(1, 2, 0).astype(np.uint8), np.ones((9, 9))) > 0
    assert (confidence.transpose(1, 2, 0)[inner] > 0.5).mean() < 0.003


def test_the_more_confident_the_smaller_the_error(
    windows: TwoWindows, short_drive: RenderedDrive
) -> None:
    error = relative_depth(windows.first, short_drive, slice(0, SIZE))
    bins = np.digitize(windows.first.confidence, [0.05, 0.2, 0.4, 0.6, 0.8])
    known = windows.first.confidence > 0
    means = [float(np.minimum(error[known & (bins == b)], 1).mean()) for b in range(6)]
    assert means == sorted(means, reverse=True)
    assert means[0] > 5 * means[-1]


def test_windows_that_go_on_agree_on_scale_and_place(
    windows: TwoWindows, short_drive: RenderedDrive
) -> None:
    """The scale of the frames they share, by depth and by cameras, is that of the truth."""
    first, second = windows.first, windows.second
    both = (first.confidence[8:] > 0.5) & (second.confidence[:4] > 0.5)
    ratio = float(np.median(first.depth[8:][both] / second.depth[:4][both]))
    truth = short_drive.world_from_cam
    scales = [
        world_from_window(first, truth[:SIZE]).scale,
        world_from_window(second, truth[8:20]).scale,
    ]
    assert ratio == pytest.approx(scales[1] / scales[0], rel=0.02)
    steps = [np.diff(p[:, :3, 3], axis=0) for p in (first.window_from_cam[8:],
                                                    second.window_from_cam[:4])]  # fmt: skip
    lengths = [np.linalg.norm(step, axis=1).sum() for step in steps]
    assert lengths[0] / lengths[1] == pytest.approx(ratio, rel=0.02)


def test_it_remembers_and_says_so(windows: TwoWindows, short_drive: RenderedDrive) -> None:
    """With earlier frames, the same window is seen otherwise: so a resumed run must repeat them."""
    promise: Backbone = backbone()
    assert promise.remembers
    alone = predict(short_drive.images[8:20], short_drive.intrinsics, 8)
    assert not np.allclose(alone.window_from_cam, windows.second.window_from_cam, atol=1e-5)


def same(first: Prediction, second: Prediction) -> bool:
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("depth", "confidence", "window_from_cam", "intrinsics")
    )


def test_the_same_images_give_the_same_answer_on_any_number_of_threads(
    small_drive: RenderedDrive,
) -> None:
    answers = []
    for num_threads in (1, 4):
        using = backbone()
        using._workers = ThreadPoolExecutor(num_threads)
        first = predict(small_drive.images[:6], small_drive.intrinsics, 0, using)
        answers.append((first, predict(small_drive.images[3:9], small_drive.intrinsics, 3, using)))
    assert same(answers[0][0], answers[1][0])
    assert same(answers[0][1], answers[1][1])


@pytest.fixture(scope="module")
def afresh(small_drive: RenderedDrive) -> Prediction:
    """What a new backbone says of frames 0 to 7."""
    return predict(small_drive.images[:8], small_drive.intrinsics)


@pytest.mark.parametrize(
    ("start", "begin"),
    [(0, 0), (2, 4), (500, 4), (8, 4), (0, 4)],
    ids=["again", "other images", "jump", "next without overlap", "another sequence"],
)
def test_a_window_that_does_not_go_on_starts_afresh(
    small_drive: RenderedDrive, afresh: Prediction, start: int, begin: int
) -> None:
    """Even where its numbers were seen before, for they may be another sequence's."""
    using = backbone()
    predict(small_drive.images[begin : begin + 8], small_drive.intrinsics, 0, using)
    answer = predict(small_drive.images[:8], small_drive.intrinsics, start, using)
    assert answer.frames[0] == start
    assert same(answer, afresh)


def test_frames_left_out_of_the_overlap_start_afresh(small_drive: RenderedDrive) -> None:
    """The window must begin with exactly the last frames seen."""
    using = backbone()
    images, K = small_drive.images, small_drive.intrinsics
    predict(images[:8], K, 0, using)
    frames = np.array([4, 5, 7, 8, 9, 10, 11, 12])
    answer = using.predict([images[i] for i in frames], frames, K)
    alone = backbone().predict([images[i] for i in frames], frames, K)
    assert same(answer, alone)
    assert position_error(answer, small_drive.world_from_cam[frames]) < 0.003


def test_images_of_another_size_start_afresh(short_drive: RenderedDrive) -> None:
    using = backbone()
    predict(short_drive.images[:8], short_drive.intrinsics, 0, using)
    small, K = resized(short_drive, 400, 120)
    assert same(predict(small[4:16], K, 4, using), predict(small[4:16], K, 4))


@pytest.mark.parametrize("sizes", [(8, 16), (16, 8)])
def test_windows_may_differ_in_length(small_drive: RenderedDrive, sizes: tuple[int, int]) -> None:
    using = backbone(replace_config(context=2))
    predict(small_drive.images[: sizes[0]], small_drive.intrinsics, 0, using)
    start = sizes[0] - 4
    end = min(24, start + sizes[1])
    answer = predict(small_drive.images[start:end], small_drive.intrinsics, start, using)
    assert position_error(answer, small_drive.world_from_cam[start:end]) < 0.003


def replace_config(**changes: int) -> ClassicalConfig:
    return FAST.model_copy(update=changes)


def test_the_memory_is_no_longer_than_a_window_and_its_context(small_drive: RenderedDrive) -> None:
    using = backbone(replace_config(context=3))
    for start in (0, 4, 8, 12):
        predict(small_drive.images[start : start + 6], small_drive.intrinsics, start, using)
        assert len(using._tracker.history) <= 9
        assert len(using._poses) <= 9


def test_a_window_may_be_longer_than_any_before(short_drive: RenderedDrive) -> None:
    images, K = resized(short_drive, 160, 48)
    using = backbone()
    predict(copies(images[0], 4), K, 0, using)
    window = predict(copies(images[0], 200), K, 0, using)
    assert_says_nothing_of_depth(window, WindowStatus.STATIC)
    assert len(window.frames) == 200


def replace_frames(window: Prediction, start: int) -> Prediction:
    """Keep the frames from ``start`` on."""
    return replace(
        window,
        frames=window.frames[start:],
        depth=window.depth[start:],
        confidence=window.confidence[start:],
        window_from_cam=window.window_from_cam[start:],
        intrinsics=window.intrinsics[start:],
    )


@pytest.mark.parametrize("sigma", [0.0, 3.0, 12.0])
def test_a_camera_that_stands_is_static(short_drive: RenderedDrive, sigma: float) -> None:
    window = predict(copies(short_drive.images[0], 20, sigma), short_drive.intrinsics)
    assert_says_nothing_of_depth(window, WindowStatus.STATIC)
    np.testing.assert_array_equal(window.window_from_cam, np.tile(np.eye(4), (20, 1, 1)))


@pytest.mark.parametrize(
    "degrees", [(0, 0.1, 0), (0, 0.8, 0), (0.3, -0.8, 0.5), (0, 2.5, 0)], ids=str
)
def test_a_camera_that_only_turns_says_how_far(
    short_drive: RenderedDrive, degrees: tuple[float, float, float]
) -> None:
    """Slow or fast: a tenth of a degree is two thirds of a pixel from frame to frame."""
    panorama = np.vstack([np.hstack(short_drive.images[i : i + 3]) for i in (0, 6, 12, 18)])
    wide_K = intrinsics_matrix(371.2, 371.2, 960, 384)
    images, cam_from_world = [], []
    for i in range(16):
        rotation = rotation_exp(np.radians(degrees) * (i - 8))
        mapping = short_drive.intrinsics @ rotation @ np.linalg.inv(wide_K)
        warped = cv2.warpPerspective(panorama, mapping, (640, 192), flags=cv2.INTER_AREA)
        images.append(noisy(np.asarray(warped, np.uint8), 1.5, i))
        cam_from_world.append(rotation)
    window = predict(images, short_drive.intrinsics)
    assert_says_nothing_of_depth(window, WindowStatus.ROTATION)
    first_from_cam = cam_from_world[0] @ np.stack(cam_from_world).transpose(0, 2, 1)
    assert rotation_error_deg(window, first_from_cam) < 0.1


@pytest.mark.parametrize(
    ("step_m", "turn_deg", "status"),
    [
        (0.0, 0.0, WindowStatus.STATIC),
        (0.0, 3.0, WindowStatus.ROTATION),
        (0.0, 30.0, WindowStatus.ROTATION),
        (0.05, 0.0, WindowStatus.FAILED),
        (0.05, 2.0, WindowStatus.FAILED),
    ],
)
def test_a_slow_motion_hides_between_frames_but_not_over_the_window(
    step_m: float, turn_deg: float, status: WindowStatus
) -> None:
    """Five centimetres a frame is half a pixel at 640 wide; it is neither still nor a turn.

    The window is judged as if it could not be reconstructed, which is why motion counts as failed.
    """
    drive = Drive(20, turn_deg=turn_deg, step_m=step_m, noise_px=0.2)
    window = without_depth(drive.views, np.arange(20), drive.intrinsics, FAST)
    assert_says_nothing_of_depth(window, status)
    if status is WindowStatus.ROTATION:
        assert rotation_error_deg(window, drive.rotations.transpose(0, 2, 1)) < 0.05


def test_a_long_turn_is_followed_over_tracks_that_leave_the_image() -> None:
    drive = Drive(40, turn_deg=160.0, step_m=0.0, noise_px=0.3, num_points=9000)
    drive.points[:] = drive.points / np.linalg.norm(drive.points, axis=1, keepdims=True) * 20
    turn = follow_turn(drive.views, drive.intrinsics)
    assert turn is not None
    gap = rotation_log(drive.rotations @ turn.window_from_cam)
    assert np.degrees(np.linalg.norm(gap, axis=1)).max() < 0.1
    assert turn.flow_px > 300
    assert turn.parallax_px < 0.5


def test_a_slow_drive_is_reconstructed(short_drive: RenderedDrive) -> None:
    """Every frame thrice: twice nothing moves, then a little."""
    frames = np.repeat(np.arange(6), 3)
    images = [noisy(short_drive.images[frame], 1.5, i) for i, frame in enumerate(frames)]
    window = predict(images, short_drive.intrinsics)
    assert window.status is WindowStatus.OK
    assert position_error(window, short_drive.world_from_cam[frames]) < 0.01


def pure_noise(num: int) -> list[Image]:
    rng = np.random.default_rng(5)
    return [rng.integers(0, 256, (192, 640, 3), dtype=np.uint8) for _ in range(num)]


@pytest.mark.parametrize("kind", ["blank", "noise", "one", "two", "unrelated"])
def test_what_cannot_be_seen_is_failed(short_drive: RenderedDrive, kind: str) -> None:
    images = short_drive.images
    rng = np.random.default_rng(6)
    scenes = {
        "blank": blank(images[0], 10),
        "noise": pure_noise(10),
        "one": images[:1],
        "two": images[:2],
        "unrelated": [np.roll(images[i], rng.integers(640, size=2), (0, 1)) for i in range(10)],
    }
    assert_says_nothing_of_depth(predict(scenes[kind], short_drive.intrinsics), WindowStatus.FAILED)


def test_three_frames_are_enough(short_drive: RenderedDrive) -> None:
    window = predict(short_drive.images[:3], short_drive.intrinsics)
    assert window.status is WindowStatus.OK
    assert position_error(window, short_drive.world_from_cam[:3]) < 0.01
    assert (window.confidence > 0.3).any()


def test_frames_around_a_blank_stretch_are_placed_as_far_as_tracks_reach(
    small_drive: RenderedDrive,
) -> None:
    images = small_drive.images
    window = predict(
        blank(images[0], 2) + images[:10] + blank(images[0], 3), small_drive.intrinsics
    )
    assert window.status is WindowStatus.OK
    assert window.warnings == ("5 of 15 frames could not be placed",)
    assert not window.confidence[[0, 1, 12, 13, 14]].any()
    assert np.isnan(window.depth[[0, 1, 12, 13, 14]]).all()
    assert window.confidence[2:12].any(axis=(1, 2)).all()
    steps = np.diff(window.window_from_cam[:, :3, 3], axis=0)[:, 2]
    assert (steps > 0).all()  # driven on through the dark
    placed = replace_frames(window, 2)
    placed = replace(placed, **{k: getattr(placed, k)[:10] for k in ARRAYS})
    assert position_error(placed, small_drive.world_from_cam[:10]) < 0.002


ARRAYS = ("frames", "depth", "confidence", "window_from_cam", "intrinsics")


def test_of_a_cut_the_larger_part_is_kept(small_drive: RenderedDrive) -> None:
    """The second window begins with four known frames, then shows another place."""
    images, K = small_drive.images, small_drive.intrinsics
    using = backbone()
    predict(images[8:24], K, 0, using)
    window = predict(images[20:24] + mirrored(images[:12]), K, 12, using)
    assert window.status is WindowStatus.OK
    assert window.warnings == ("4 of 16 frames could not be placed",)
    assert window.confidence[4:].any(axis=(1, 2)).all()
    flip = np.diag([-1.0, 1, 1, 1])
    truth = flip @ small_drive.world_from_cam[:12] @ flip
    assert position_error(replace_frames(window, 4), truth) < 0.003


@pytest.mark.parametrize(
    ("context", "status"), [(8, WindowStatus.OK), (0, WindowStatus.STATIC)], ids=["with", "without"]
)
def test_with_its_context_a_standing_camera_knows_what_it_sees(
    small_drive: RenderedDrive, context: int, status: WindowStatus
) -> None:
    images, K = small_drive.images, small_drive.intrinsics
    using = backbone(replace_config(context=context))
    predict(images[:8], K, 0, using)
    standing = copies(images[7], 8, 1.0)
    predict(images[4:8] + standing[:4], K, 4, using)
    window = predict(standing, K, 8, using)
    assert window.status is status
    assert window.confidence.any() == (status is WindowStatus.OK)


def test_a_drive_goes_on_from_what_it_knows_where_half_the_window_is_dark(
    small_drive: RenderedDrive,
) -> None:
    images, K = small_drive.images, small_drive.intrinsics
    using = backbone()
    before = predict(images[:10], K, 0, using)
    window = predict(images[6:13] + blank(images[0], 3), K, 6, using)
    assert window.warnings == ("3 of 10 frames could not be placed",)
    both = (before.confidence[6:] > 0.3) & (window.confidence[:4] > 0.3)
    ratio = before.depth[6:][both] / window.depth[:4][both]
    truth = small_drive.world_from_cam
    path = np.linalg.norm(np.diff(truth[6:13, :3, 3], axis=0), axis=1).sum()
    own = np.linalg.norm(np.diff(window.window_from_cam[:7, :3, 3], axis=0), axis=1).sum()
    scale = world_from_window(before, truth[:10]).scale
    assert float(np.median(ratio)) * own * scale == pytest.approx(path, rel=0.02)


@pytest.mark.parametrize("order", ["stop then go", "go then stop"])
def test_a_car_that_stands_for_most_of_a_window_is_placed_where_it_stands(
    short_drive: RenderedDrive, order: str
) -> None:
    frames = np.concatenate([np.zeros(11, int), np.arange(1, 6)])
    if order == "go then stop":
        frames = 5 - frames[::-1]
    images = [noisy(short_drive.images[f], 1.5, i) for i, f in enumerate(frames)]
    window = predict(
        images, short_drive.intrinsics, using=backbone(replace_config(depth_width=320))
    )
    assert window.status is WindowStatus.OK
    assert window.warnings == ()
    assert position_error(window, short_drive.world_from_cam[frames]) < 0.005
    size = window.depth.shape[:0:-1]
    truth = [cv2.resize(short_drive.depths[f], size, interpolation=0) for f in frames]
    scale = world_from_window(window, short_drive.world_from_cam[frames]).scale
    is_confident = window.confidence > 0.5
    error = np.abs(window.depth * scale / np.stack(truth) - 1)[is_confident]
    assert (error < 0.1).mean() > 0.9
    assert is_confident[frames == frames[8]].mean() > 0.2  # standing frames too


def with_lorry(
    images: Sequence[Image], first: int, side: Image
) -> tuple[list[Image], NDArray[np.bool_]]:
    """Let a thing weave over a third of the images from ``first`` on."""
    out, hidden = list(images), np.zeros((len(images), 192, 640), bool)
    for i in range(first, len(images)):
        x, y = 200 + int(20 * np.sin(i)), 10 + int(8 * np.cos(1.3 * i))
        hidden[i, y : y + 175, x : x + 230] = True
        image = images[i].copy()
        image[y : y + 175, x : x + 230] = side[: 192 - y]
        out[i] = noisy(image, 1.0, i)
    return out, hidden


def lettered() -> Image:
    """Draw the side of a lorry: plain, with some letters."""
    side = np.full((175, 230, 3), (170, 60, 50), np.uint8)
    for row, text in enumerate(("MOVING", "HOMES", "SINCE 1896")):
        corner = (15, 50 + 45 * row)
        cv2.putText(side, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 1.1, (240, 230, 200), 4)
    return side


def mottled() -> Image:
    """Draw a thing that has more corners than all else together."""
    side = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(175, 230, 3)), (0, 0), 3)
    return np.asarray(np.clip(120 + 25 * side / side.std(), 0, 255), np.uint8)


def test_what_moves_is_not_trusted_and_does_not_move_the_camera(short_drive: RenderedDrive) -> None:
    using = backbone(replace_config(depth_width=320, num_planes=64))
    images, K = short_drive.images, short_drive.intrinsics
    predict(images[:10], K, 0, using)
    traffic, hidden = with_lorry(images[4:18], 6, lettered())
    window = predict(traffic, K, 4, using)
    assert 0.3 < hidden[6:].mean() < 0.35
    assert position_error(window, short_drive.world_from_cam[4:18]) < 0.002
    error = relative_depth(window, short_drive, slice(4, 18))
    is_hidden = np.stack(
        [cv2.resize(m.astype(np.uint8), (320, 96), interpolation=0) for m in hidden]
    )
    is_confident = window.confidence > 0.5
    assert is_confident[is_hidden > 0].mean() < 0.01
    assert is_confident[is_hidden == 0].mean() > 0.25
    assert (error[is_confident & (is_hidden == 0)] < 0.1).mean() > 0.9


def test_much_that_moves_is_warned_of(short_drive: RenderedDrive) -> None:
    traffic, _ = with_lorry(short_drive.images[:SIZE], 0, mottled())
    window = predict(traffic, short_drive.intrinsics)
    assert len(window.warnings) == 1
    assert "of the tracks fit a static scene" in window.warnings[0]


def test_unknown_intrinsics_are_those_of_a_common_camera(short_drive: RenderedDrive) -> None:
    window = predict(short_drive.images[:SIZE], None)
    assert window.status is WindowStatus.OK
    K = window.intrinsics[0]
    assert K[0, 0] == pytest.approx(0.6 * 128)
    assert K[0, 2] == pytest.approx(63.5)
    assert position_error(window, short_drive.world_from_cam[:SIZE]) < 0.005


@pytest.mark.parametrize(
    ("width", "height", "columns"),
    [
        (641, 193, slice(0, 640)),
        (333, 101, slice(0, 640)),
        (216, 384, slice(266, 374)),
        (341, 192, slice(149, 490)),
    ],
    ids=["odd", "small and odd", "tall", "half"],
)
def test_any_shape_of_image_will_do(
    short_drive: RenderedDrive, width: int, height: int, columns: slice
) -> None:
    images, K = resized(short_drive, width, height, columns)
    using = backbone(replace_config(depth_width=640))
    assert using.image_size((height, width)) == (height, width)
    window = predict(images[:10], K, using=using)
    assert window.status is WindowStatus.OK
    assert window.depth.shape == (10, height, min(width, 640))
    placed = window.confidence.any(axis=(1, 2))
    assert placed.sum() >= 9
    assert position_error(window, short_drive.world_from_cam[:10]) < 0.01
    error = relative_depth(window, short_drive_columns(short_drive, columns), slice(0, 10))
    assert (error[window.confidence > 0.5] < 0.1).mean() > 0.9


def short_drive_columns(drive: RenderedDrive, columns: slice) -> RenderedDrive:
    return replace(drive, depths=drive.depths[:, :, columns])


@pytest.mark.parametrize(("width", "height"), [(160, 90), (90, 160), (64, 48), (20, 12)])
def test_tiny_images_are_predicted_or_failed_but_never_raise(
    short_drive: RenderedDrive, width: int, height: int
) -> None:
    images, K = resized(short_drive, width, height, slice(149, 490))
    window = predict(images[:8], K)
    assert window.depth.shape[1] * window.depth.shape[2] <= width * height
    assert window.status in (WindowStatus.OK, WindowStatus.FAILED)


def test_large_images_are_reduced(short_drive: RenderedDrive) -> None:
    using = backbone(replace_config(max_width=320, depth_width=160))
    assert backbone().image_size((1500, 2000)) == (960, 1280)
    assert backbone().image_size((2000, 1500)) == (1707, 1280)
    size = using.image_size((192, 640))
    assert size == (96, 320)
    images, K = resized(short_drive, size[1], size[0])
    window = predict(images[:10], K, using=using)
    assert window.depth.shape[1:] == (48, 160)
    np.testing.assert_allclose(
        window.intrinsics[0], resize_intrinsics(short_drive.intrinsics, (192, 640), (48, 160))
    )
    assert position_error(window, short_drive.world_from_cam[:10]) < 0.005


def eventful(drive: RenderedDrive) -> list[Image | None]:
    """A drive that goes dark, stands, is unreadable once, is cut to another place, and drives."""
    here, there = drive.images[:13], mirrored(drive.images[13:24])
    dark = blank(here[0], 3)
    return [*here[:10], *dark, *here[10:], *copies(here[12], 6), None, *there, *dark[:2]]


@dataclass
class Eventful:
    """The eventful drive as a data set."""

    images: list[Image | None]
    intrinsics: Array

    @property
    def info(self) -> SequenceInfo:
        return SequenceInfo("eventful", (192, 640), len(self.images), self.intrinsics, "rendered")

    def frames(self) -> Generator[Frame, None, None]:
        for index, image in enumerate(self.images):
            yield Frame(index, index / 10.0, image)

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        return None


def test_a_run_over_all_that_may_happen_has_a_pose_for_every_frame(
    short_drive: RenderedDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pipeline leaves out what stands and what is dark, so only the cut must be bridged."""
    leave_pictures_out(monkeypatch)
    dataset = Eventful(eventful(short_drive), short_drive.intrinsics)
    settings = {"windows": {"size": 8, "overlap": 3}, "calibration": {"keyframes": 0}}
    config = Config.model_validate(
        {
            **settings,
            "backbone": {"classical": FAST.model_dump()},
            "fusion": {"min_observations": 1},
        }
    )
    results = Pipeline(dataset, config, tmp_path / "run").run()
    num, report = len(dataset.images), results.report
    assert np.array_equal(results.trajectory.frames, np.arange(num))
    assert np.isfinite(results.trajectory.world_from_cam).all()
    assert report["frames"]["read"] == num
    assert report["frames"]["unreadable"] == 1
    assert 20 <= report["frames"]["keyframes"] <= 26
    assert 1 <= len(report["windows"]["bridged"]) <= 2
    warnings = report["warnings"]
    assert len(warnings) == len(set(warnings))
    assert sum("bridged" in warning for warning in warnings) == len(report["windows"]["bridged"])
    assert sum("cannot be read" in warning for warning in warnings) == 1
    assert len(results.cloud.points) > 1000
    seen = np.array([*range(10), *range(13, 16)])
    found = results.trajectory.world_from_cam[seen, :3, 3]
    truth = short_drive.centres[:13]
    assert np.abs(umeyama(found, truth).apply(found) - truth).max() < 0.005 * short_drive.path_m


def test_windows_of_darkness_and_of_standing_are_bridged_and_each_is_warned_of_once(
    short_drive: RenderedDrive, caplog: pytest.LogCaptureFixture
) -> None:
    """Without keyframes: every frame reaches the backbone."""
    here, K = resized(short_drive, 320, 96)
    images = [*here[:8], *blank(here[0], 12), *copies(here[8], 14), *here[9:24]]
    using, slam = backbone(), Slam(Config())
    statuses = []
    with caplog.at_level(logging.WARNING, "laser_slam"):
        for start in range(0, len(images) - 7, 5):
            window = predict(images[start : start + 8], K, start, using)
            height, width = window.depth.shape[1:]
            slam.add(window, np.zeros((8, height, width, 3), np.uint8))
            statuses.append(window.status)
    assert {WindowStatus.OK, WindowStatus.FAILED, WindowStatus.STATIC} == set(statuses)
    assert statuses[0] is statuses[-1] is WindowStatus.OK
    warned = [record.getMessage().split(" is bridged")[0] for record in caplog.records]
    assert warned == [f"window {index}" for index in slam.bridged]
    trajectory = slam.trajectory(np.arange(len(images)) / 10.0)
    assert np.isfinite(trajectory.world_from_cam).all()
    assert len(trajectory.frames) == 5 * len(statuses) + 3
