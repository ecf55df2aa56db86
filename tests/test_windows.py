"""Keyframes follow the motion of the camera; windows cover them all and overlap."""

import os
from collections.abc import Callable, Iterator, Sequence
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix, project, resize_intrinsics
from laser_slam.config import WindowsConfig
from laser_slam.datasets.images import ImageFolder
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.errors import DegenerateGeometryError
from laser_slam.rectification import Rectifier
from laser_slam.sim3 import rotation_exp
from laser_slam.types import NO_DISTORTION, Calibration, Frame, Image
from laser_slam.windows import cut_windows, rotation_residual, select_keyframes

HEIGHT, WIDTH = 240, 640
INTRINSICS = intrinsics_matrix(400.0, 400.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
CONFIG = WindowsConfig()


def resized(size: tuple[int, int]) -> Callable[[Image], Image]:
    return Rectifier(Calibration(None, NO_DISTORTION, size, ""), size).image


def texture(seed: int) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(np.clip(128 + 50 * smooth / smooth.std(), 0, 255), np.float32)


def as_image(grey: NDArray[np.float32], seed: int = 0, noise: float = 2.0) -> Image:
    noisy = grey + np.random.default_rng(seed).normal(scale=noise, size=grey.shape)
    return np.dstack([np.clip(noisy, 0, 255).astype(np.uint8)] * 3)


def shifted(grey: NDArray[np.float32], pixels: float) -> NDArray[np.float32]:
    matrix = np.array([[1, 0, pixels], [0, 1, 0]], np.float32)
    size = (grey.shape[1], grey.shape[0])
    return np.asarray(cv2.warpAffine(grey, matrix, size, borderMode=cv2.BORDER_WRAP))


def sideways(pixels: float, seed: int = 0, enlarged: int = 1) -> Image:
    """See a far wall above and a near floor below from a camera that moved to the side.

    The wall moves by ``pixels``, the floor by three times as much, before it is enlarged.
    """
    half = HEIGHT // 2
    grey = texture(7)
    grey = np.vstack([shifted(grey[:half], pixels), shifted(grey[half:], 3 * pixels)])
    return as_image(cv2.resize(grey, None, fx=enlarged, fy=enlarged), seed)


def turned(angle_deg: float, seed: int = 0) -> Image:
    """See a wall from a camera that turned to the side where it stands."""
    rotation = rotation_exp(np.array([0.0, np.radians(angle_deg), 0.0]))
    homography = INTRINSICS @ rotation @ np.linalg.inv(INTRINSICS)
    grey = cv2.warpPerspective(
        texture(7), homography, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
    )
    return as_image(grey, seed)


def sequence(images: Sequence[Image | None]) -> list[Frame]:
    return [Frame(index, 0.1 * index, image) for index, image in enumerate(images)]


def chosen(
    images: Sequence[Image | None],
    config: WindowsConfig = CONFIG,
    intrinsics: NDArray[np.float64] | None = INTRINSICS,
) -> list[int]:
    size = next(image.shape[:2] for image in images if image is not None)
    frames = sequence(images)
    return [frame.index for frame in select_keyframes(frames, config, intrinsics, size)]


# Keyframes


def test_a_standing_camera_gives_one_keyframe() -> None:
    assert chosen([sideways(0.0, seed) for seed in range(40)]) == [0]


def test_traffic_that_passes_a_standing_camera_makes_no_keyframes() -> None:
    images = []
    for step in range(10):
        grey = texture(7)
        grey[100:180, 200:400] = shifted(texture(8), 6.0 * step)[100:180, 200:400]
        images.append(as_image(grey, step))
    assert chosen(images) == [0]


def test_a_camera_that_moves_well_gives_all_frames() -> None:
    assert chosen([sideways(4.0 * step, step) for step in range(8)]) == list(range(8))


def test_slow_motion_gives_a_keyframe_whenever_enough_of_it_has_gathered() -> None:
    images = [sideways(0.5 * step, step) for step in range(25)]
    few = chosen(images, WindowsConfig(min_parallax_px=3.0))
    many = chosen(images, WindowsConfig(min_parallax_px=1.5))
    assert 1.6 < (len(many) - 1) / (len(few) - 1) < 2.4
    assert max(np.diff(few)) - min(np.diff(few[:-1])) <= 1


def test_the_choice_does_not_depend_on_the_size_of_the_images() -> None:
    small = [sideways(0.5 * step, step) for step in range(20)]
    large = [sideways(0.5 * step, step, enlarged=2) for step in range(20)]
    larger = resize_intrinsics(INTRINSICS, (HEIGHT, WIDTH), (2 * HEIGHT, 2 * WIDTH))
    first, second = np.array(chosen(small)), np.array(chosen(large, intrinsics=larger))
    assert len(first) == len(second)
    assert np.abs(first - second).max() <= 1


def test_rotation_is_no_parallax() -> None:
    images = [turned(0.8 * step, step) for step in range(6)]  # 5.6 px each
    assert chosen(images, WindowsConfig(max_flow_px=1000)) == [0, 5]  # 5: the end


def test_much_rotation_makes_keyframes_anyway() -> None:
    images = [turned(1.0 * step, step) for step in range(13)]  # 7 px each
    assert chosen(images, WindowsConfig(max_flow_px=20)) == [0, 3, 6, 9, 12]


def test_rotation_is_no_parallax_with_a_roughly_assumed_focal_length_either() -> None:
    images = [turned(0.4 * step, step) for step in range(6)]
    assert chosen(images, intrinsics=None) == [0, 5]


def test_a_cut_to_another_scene_makes_a_keyframe() -> None:
    other = [as_image(texture(8), seed) for seed in range(3)]
    assert chosen([sideways(0.0, seed) for seed in range(3)] + other) == [0, 3]


def test_a_keyframe_that_is_mostly_covered_is_replaced() -> None:
    """What is left of the first view does not move, but shows too little of it."""
    covered = texture(7)
    covered[:, WIDTH // 8 :] = texture(8)[:, WIDTH // 8 :]
    images = [sideways(0.0, 0), sideways(0.0, 1), as_image(covered, 2), as_image(covered, 3)]
    assert chosen(images) == [0, 2]


def test_a_flickering_screen_makes_no_keyframes() -> None:
    images = []
    for step in range(6):
        grey = texture(7)
        grey[:, WIDTH // 2 :] = texture(10 + step)[:, WIDTH // 2 :]
        images.append(as_image(grey, step))
    assert chosen(images) == [0]


def test_unreadable_and_blank_frames_are_never_keyframes() -> None:
    blank = as_image(np.full((HEIGHT, WIDTH), 90, np.float32))
    dark = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    seen = [sideways(4.0 * step, step) for step in range(4)]
    images = [None, blank, seen[0], None, seen[1], blank, dark, seen[2], seen[3], None, dark]
    assert chosen(images) == [2, 4, 7, 8]


def test_a_wall_without_texture_gives_no_keyframe() -> None:
    shading = np.tile(np.linspace(90, 120, WIDTH, dtype=np.float32), (HEIGHT, 1))
    assert chosen([as_image(shading, seed) for seed in range(5)]) == []


def test_the_last_good_frame_is_a_keyframe_if_it_moved() -> None:
    still = [sideways(4.0, seed) for seed in range(5)]
    assert chosen([sideways(0.0), *still]) == [0, 1]
    assert chosen([sideways(0.0), *still, sideways(4.4, 9), None]) == [0, 1, 6]


def test_a_threshold_of_zero_keeps_every_frame() -> None:
    config = WindowsConfig(min_parallax_px=0)
    assert chosen([sideways(0.0, seed) for seed in range(5)], config) == list(range(5))


def test_keyframes_come_as_soon_as_they_are_read() -> None:
    read: list[int] = []

    def frames() -> Iterator[Frame]:
        for frame in sequence([sideways(4.0 * step) for step in range(6)]):
            read.append(frame.index)
            yield frame

    keyframes = select_keyframes(frames(), CONFIG, INTRINSICS, (HEIGHT, WIDTH))
    assert next(keyframes).index == 0
    assert next(keyframes).index == 1
    assert read == [0, 1]


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_leaves_no_residual_but_of_the_points_with_parallax(seed: int) -> None:
    """Points at infinity around a turning camera; a third of them get parallax on top."""
    rng = np.random.default_rng(seed)
    start = rng.uniform((20, 20), (WIDTH - 20, HEIGHT - 20), (150, 2))
    rays = np.column_stack([start, np.ones(150)]) @ np.linalg.inv(INTRINSICS).T
    end = project(rays @ rotation_exp(rng.normal(scale=0.05, size=3)).T, INTRINSICS)
    parallax = np.zeros((150, 2))
    parallax[:50, 0] = rng.uniform(4, 12, 50)
    noise = rng.normal(scale=0.1, size=(150, 2))
    residual = rotation_residual(
        start.astype(np.float32), (end + parallax + noise).astype(np.float32), INTRINSICS
    )
    assert np.median(residual[50:]) < 0.3
    np.testing.assert_allclose(residual[:50], parallax[:50, 0], atol=0.8)


# Windows


def keyframes(num: int, on_read: Callable[[int], None] = lambda _: None) -> Iterator[Frame]:
    for index in range(num):
        on_read(index)
        yield Frame(3 * index, 0.3 * index, np.full((6, 8, 3), index, np.uint8))


@pytest.mark.parametrize("num", [2, 3, 4, 5, 6, 7, 8, 11, 12, 13, 40])
@pytest.mark.parametrize(("size", "overlap"), [(3, 1), (5, 2), (6, 5), (12, 3)])
def test_windows_cover_all_keyframes_and_overlap(num: int, size: int, overlap: int) -> None:
    config = WindowsConfig(size=size, overlap=overlap)
    windows = list(cut_windows(keyframes(num), config, resized((6, 8))))
    assert [window.index for window in windows] == list(range(len(windows)))
    covered = np.unique(np.concatenate([window.frames for window in windows]))
    np.testing.assert_array_equal(covered, 3 * np.arange(num))
    for window in windows:
        np.testing.assert_array_equal(np.diff(window.frames), 3)
        assert [int(image[0, 0, 0]) * 3 for image in window.images] == window.frames.tolist()
        assert len(window.frames) == min(size, num)
    shared = [
        len(np.intersect1d(one.frames, next_one.frames)) for one, next_one in pairwise(windows)
    ]
    assert all(count == overlap for count in shared[:-1])
    assert all(overlap <= count < size for count in shared[-1:])


def test_a_window_comes_as_soon_as_it_is_full() -> None:
    read: list[int] = []
    config = WindowsConfig(size=5, overlap=2)
    windows = cut_windows(keyframes(100, read.append), config, resized((6, 8)))
    assert len(list(islice(windows, 1))) == 1
    assert len(read) == 5
    next(windows)
    assert len(read) == 8


@pytest.mark.parametrize("size", [(3, 4), (6, 8), (12, 16)])
def test_images_are_resized_to_what_the_backbone_wants(size: tuple[int, int]) -> None:
    window = next(cut_windows(keyframes(3), WindowsConfig(size=3, overlap=1), resized(size)))
    assert [image.shape for image in window.images] == [(*size, 3)] * 3
    assert [int(image.mean()) for image in window.images] == [0, 1, 2]


def test_shrinking_averages_instead_of_picking_pixels() -> None:
    stripes = np.zeros((8, 16, 3), np.uint8)
    stripes[:, ::4] = 200
    frames = [Frame(index, index, stripes) for index in range(3)]
    window = next(cut_windows(frames, WindowsConfig(size=3, overlap=1), resized((2, 4))))
    assert np.abs(window.images[0].astype(int) - 50).max() <= 20  # a picked pixel is 0 or 200


def test_too_few_keyframes_are_refused_with_advice() -> None:
    with pytest.raises(DegenerateGeometryError, match=r"only 1 keyframe: .*min_parallax_px"):
        list(cut_windows(keyframes(1), CONFIG, resized((6, 8))))
    with pytest.raises(DegenerateGeometryError, match="no image shows enough texture"):
        list(cut_windows(keyframes(0), CONFIG, resized((6, 8))))


# Real images


@pytest.mark.skipif("LASER_SLAM_DATA" not in os.environ, reason="set LASER_SLAM_DATA to real data")
def test_a_real_drive_uses_nearly_all_frames_and_a_slow_camera_few() -> None:
    data = Path(os.environ["LASER_SLAM_DATA"])
    drive = KittiOdometry(data / "kitti_odometry", "06")
    room = ImageFolder(data / "7scenes/kitchen/seq-01/*.color.jpg", fov_deg=57.4)
    for dataset, low, high in ((drive, 0.9, 1.0), (room, 0.1, 0.6)):
        info = dataset.info
        frames = list(islice(dataset.frames(), 60))
        kept = list(select_keyframes(frames, CONFIG, info.intrinsics, info.size))
        assert low <= len(kept) / len(frames) <= high
