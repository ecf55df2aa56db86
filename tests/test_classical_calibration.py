"""Self-calibration: it finds the lens from tracks, and says so where it cannot."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rendered import RenderedDrive
from tracks import SIZE, Drive, true_camera

from laser_slam.backbones.classical import calibration
from laser_slam.backbones.classical.calibration import Clip, calibrate, calibrate_clips, make_clip
from laser_slam.camera import distort
from laser_slam.config import ClassicalConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array
from laser_slam.types import Calibration, Image, Window

CONFIG = ClassicalConfig(refine_radius=0)  # tracks without images
WORKERS = ThreadPoolExecutor(2)
FOCAL = 720.0
LENS = np.array([-0.08, 0.03, 0.0, 0.0])
TURNING = Drive(num_frames=10, turn_deg=25, num_points=800)


def clips(drive: Drive, num: int = 4, K: Array | None = None) -> list[Clip]:
    """Return windows that are the same drive past other points."""
    views = [replace(drive, seed=10 * seed).views for seed in range(num)]
    return [make_clip(window, true_camera() if K is None else K) for window in views]


def measured(drive: Drive, given: Array | None, num: int = 4) -> Calibration:
    return calibrate_clips(clips(drive, num), given, CONFIG, WORKERS)


def bend_px(distortion: Array, lens: Array) -> float:
    """Return by how much two distortions disagree at worst, inside the image."""
    r = np.linspace(0, 0.5 * SIZE[1] / FOCAL, 50)
    rays = np.stack([r, 0 * r], axis=1)
    return float(FOCAL * np.abs(distort(rays, distortion) - distort(rays, lens)).max())


@pytest.mark.parametrize("error", [-0.02, 0.02])
@pytest.mark.parametrize("lens", [LENS, np.array([0.05, 0.0, 0.0, 0.0])])
def test_focal_length_and_distortion_are_found_to_a_fraction_of_a_pixel(
    error: float, lens: Array
) -> None:
    drive = replace(TURNING, distortion=lens)
    found = measured(drive, true_camera(FOCAL * (1 + error)), num=6)
    assert found.intrinsics is not None
    assert found.source == "given, refined on 6 windows"
    assert found.size == SIZE
    assert found.intrinsics[0, 0] == pytest.approx(FOCAL, rel=0.01)
    np.testing.assert_allclose(found.distortion, lens, atol=0.015)
    assert bend_px(found.distortion, lens) < 0.1 * bend_px(np.zeros(4), lens)


def test_a_straight_lens_stays_straight() -> None:
    found = measured(TURNING, true_camera())
    assert found.source.endswith("ed on 4 windows")  # refined, or confirmed
    assert np.abs(found.distortion).max() < 0.006
    assert bend_px(found.distortion, np.zeros(4)) < 0.7


def test_pixels_that_are_not_square_stay_so() -> None:
    K = true_camera()
    K[1, 1] *= 1.1
    drive = replace(TURNING, intrinsics=K.copy())
    K[:2, :2] *= 1.01
    found = measured(drive, K)
    assert found.intrinsics is not None
    assert found.intrinsics[1, 1] / found.intrinsics[0, 0] == pytest.approx(1.1)
    assert found.intrinsics[0, 0] == pytest.approx(FOCAL, rel=0.011)


def test_a_tenth_of_outliers_hardly_matters() -> None:
    found = measured(replace(TURNING, distortion=LENS, outliers=0.1), true_camera())
    assert found.source == "given, refined on 4 windows"
    np.testing.assert_allclose(found.distortion, LENS, atol=0.02)


def test_the_order_of_the_windows_does_not_matter() -> None:
    windows = clips(replace(TURNING, distortion=LENS))
    first = calibrate_clips(windows, true_camera(730.0), CONFIG, WORKERS)
    second = calibrate_clips(windows[::-1], true_camera(730.0), CONFIG, WORKERS)
    assert first.source == second.source == "given, refined on 4 windows"
    assert first.intrinsics is not None
    assert second.intrinsics is not None
    np.testing.assert_allclose(first.intrinsics, second.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(first.distortion, second.distortion, atol=1e-6)


@pytest.mark.parametrize("focal", [600.0, 1000.0])
def test_an_unknown_focal_length_is_found_on_a_turning_path(focal: float) -> None:
    drive = replace(TURNING, intrinsics=true_camera(focal), num_points=400)
    found = measured(drive, None, num=3)
    assert found.intrinsics is not None
    assert found.source.startswith("estimated from the images")
    assert found.intrinsics[0, 0] == pytest.approx(focal, rel=0.05)
    assert found.intrinsics[0, 0] == found.intrinsics[1, 1]


def test_a_focal_length_beyond_what_is_tried_is_called_so() -> None:
    drive = replace(TURNING, intrinsics=true_camera(2.4 * SIZE[1]), num_points=1500)
    assert "at the end of what was tried" in measured(drive, None, num=2).source


def test_a_straight_path_leaves_the_focal_length_a_guess_that_is_called_one() -> None:
    found = measured(replace(TURNING, turn_deg=0), None)
    assert found.intrinsics is not None
    assert found.source.startswith("guessed: the clip turns too little")
    assert found.intrinsics[0, 0] == pytest.approx(0.6 * SIZE[1], rel=0.004)


@pytest.mark.parametrize("step_m", [0.0, 0.9])
def test_what_does_not_tell_gives_back_what_was_given(step_m: float) -> None:
    """No motion at all, or a single window."""
    given = true_camera(700.0)
    found = measured(replace(TURNING, step_m=step_m), given, num=3 if step_m == 0 else 1)
    assert found.source == "given, unrefined: too little moves"
    np.testing.assert_array_equal(found.intrinsics, given)
    np.testing.assert_array_equal(found.distortion, 0)


def test_windows_of_which_only_a_part_has_poses_still_tell() -> None:
    """In one window all tracks end half-way; another is shorter; one has nothing to see."""
    windows = clips(replace(TURNING, distortion=LENS), 5)
    cut = [replace(view, ids=view.ids + 9999 * (view.frame > 5)) for view in windows[0].views]
    blank = [replace(v, ids=v.ids[:0], pixels=v.pixels[:0]) for v in windows[2].views]
    windows[0] = Clip(cut, windows[0].turn_deg)
    windows[1] = Clip(windows[1].views[:5], windows[1].turn_deg)
    windows[2] = make_clip(blank, true_camera())
    found = calibrate_clips(windows, true_camera(), CONFIG, WORKERS)
    assert found.source == "given, refined on 4 windows"
    np.testing.assert_allclose(found.distortion, LENS, atol=0.015)


@pytest.mark.parametrize("fault", ["singular", "nan"])
def test_equations_without_a_solution_leave_the_camera_as_given(
    fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> tuple[Array, ...]:
        if fault == "singular":
            raise np.linalg.LinAlgError("Singular matrix")
        return np.full((7, 7), np.nan), np.full(7, np.nan)

    monkeypatch.setattr(calibration, "_reduced", broken)
    found = measured(TURNING, true_camera(), num=2)
    assert found.source == "given, unrefined: the clip does not tell"
    np.testing.assert_array_equal(found.intrinsics, true_camera())


def test_a_lens_that_would_fold_the_image_is_known() -> None:
    """The radius r (1 + k1 r2) grows up to r2 = -1 / (3 k1)."""
    corner = np.array([1.0, 0.3])
    assert not calibration._folds(np.array([-0.30, 0.0]), corner)
    assert calibration._folds(np.array([-0.31, 0.0]), corner)
    assert not calibration._folds(np.array([-0.31, 0.05]), corner)
    assert not calibration._folds(np.array([0.4, 0.0]), corner)


def test_what_is_assumed_before_weighs_against_what_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With a sigma at which both weigh alike, the result lies between, not at either end."""
    drive = replace(TURNING, distortion=np.array([-0.08, 0.0, 0.0, 0.0]))
    monkeypatch.setattr(calibration, "KNOWN_PRIOR", (1e-5, 1e-5, 1e-5, 3e-3, 1e-5, 1e-5, 1e-5))
    found = measured(drive, true_camera())
    assert -0.065 < found.distortion[0] < -0.03
    assert found.intrinsics is not None
    assert found.intrinsics[0, 0] == pytest.approx(FOCAL, rel=1e-4)


@pytest.mark.parametrize(("error", "is_doubted"), [(0.01, False), (0.25, True)])
def test_a_focal_length_far_from_what_the_images_say_is_doubted(
    error: float, is_doubted: bool
) -> None:
    found = measured(TURNING, true_camera(FOCAL * (1 + error)))
    assert (found.warning is not None) == is_doubted
    assert not is_doubted or "check what was given" in str(found.warning)


def test_no_window_is_said_in_one_line() -> None:
    with pytest.raises(DegenerateGeometryError, match="no window to calibrate the camera by"):
        calibrate([], true_camera(), CONFIG, WORKERS)


def cut(images: list[Image], starts: tuple[int, ...], size: int) -> list[Window]:
    return [
        Window(k, np.arange(start, start + size), tuple(images[start : start + size]))
        for k, start in enumerate(starts)
    ]


def test_blank_images_leave_the_camera_as_given() -> None:
    blank: list[NDArray[np.uint8]] = [np.full((96, 320, 3), 127, np.uint8)] * 12
    K = true_camera(200.0)
    found = calibrate(cut(blank, (0, 6), 6), K, ClassicalConfig(), WORKERS)
    np.testing.assert_array_equal(found.intrinsics, K)
    assert found.size == (96, 320)
    guessed = calibrate(cut(blank, (0, 6), 6), None, ClassicalConfig(), WORKERS)
    assert guessed.source.startswith("guessed")


def test_long_windows_are_followed_whole_and_shared_frames_once() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (48, 64, 3)).astype(np.uint8), (0, 0), 1.5)
    windows = cut([image] * 420, (0, 120), 300)
    first, second = calibration.follow(windows, None, ClassicalConfig())
    for clip, window in ((first, windows[0]), (second, windows[1])):
        assert [view.frame for view in clip.views] == window.frames.tolist()
    assert first.views[120] is second.views[0]
    assert first.views[-1] is second.views[179]


def test_a_rendered_drive_through_a_lens_gives_the_lens(short_drive: RenderedDrive) -> None:
    """From images to distortion, through tracks and patches; three windows tell it roughly."""
    lens, K = np.array([-0.06, 0.0, 0.0, 0.0]), short_drive.intrinsics
    grid = np.stack(np.meshgrid(np.arange(640.0), np.arange(192.0)), axis=-1).reshape(-1, 1, 2)
    source = cv2.undistortPoints(grid, K, lens, P=K)
    maps = source.reshape(192, 640, 2).astype(np.float32)
    bent = [cv2.remap(i, maps, None, cv2.INTER_CUBIC) for i in short_drive.images]
    found = calibrate(cut(bent, (0, 6, 12), 12), K, ClassicalConfig(), WORKERS)
    assert found.source == "given, refined on 3 windows"
    r = np.stack([np.linspace(0, 0.85, 20), np.zeros(20)], axis=1)
    assert found.intrinsics is not None
    ours = distort(r, found.distortion) * found.intrinsics[0, 0]
    true = distort(r, lens) * K[0, 0]
    left = np.abs(ours - true).max() / np.abs(r * K[0, 0] - true).max()
    assert left < 0.25
