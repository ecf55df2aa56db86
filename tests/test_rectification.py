"""Rectification: straight lines are straight, every pixel comes from the image, files come back."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow

from laser_slam.camera import distort, intrinsics_matrix, resize_intrinsics
from laser_slam.errors import DegenerateGeometryError, RunFolderError
from laser_slam.rectification import Rectifier, load_calibration, save_calibration
from laser_slam.sim3 import Array
from laser_slam.types import Calibration, Image

SIZE = (192, 640)
K = intrinsics_matrix(360.0, 370.0, 315.0, 100.0)
LENSES = [
    (-0.3, 0.05, 0.0, 0.0),
    (-0.1, 0.0, 0.002, -0.003),
    (0.12, 0.0, 0.0, 0.0),
    (0.1, 0.06, -0.001, 0.004),
]


def camera(lens: tuple[float, ...], size: tuple[int, int] = SIZE) -> Calibration:
    return Calibration(K, np.array(lens), size, "made up")


def seen_slopes(lens: tuple[float, ...], size: tuple[int, int] = SIZE) -> Array:
    """Return the (H, W, 2) slopes x / z, y / z of what each pixel of the distorted image shows."""
    x, y = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    shown = (np.stack([x, y], axis=-1) - K[:2, 2]) / K[[0, 1], [0, 1]]
    slopes = shown.copy()
    for _ in range(200):
        slopes = slopes + 0.7 * (shown - distort(slopes, np.array(lens)))
    np.testing.assert_allclose(distort(slopes, np.array(lens)), shown, atol=1e-9)
    return np.asarray(slopes)


def line_image(slopes: Array, a: float, b: float) -> Image:
    """Draw the line y = a x + b of slopes as a soft bright stripe."""
    distance = (slopes[..., 1] - a * slopes[..., 0] - b) * K[1, 1] / np.hypot(1, a)
    grey = 20 + 220 * np.exp(-((distance / 1.5) ** 2))
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def line_rows(image: Image) -> tuple[NDArray[np.int64], Array]:
    """Return columns, and the sub-pixel rows at which the stripe crosses them."""
    weight = np.clip(image[..., 0].astype(np.float64) - 30, 0, None)
    columns = np.flatnonzero(weight[4:-4].max(axis=0) > 150)
    rows = (weight * np.arange(len(image))[:, None]).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
    return columns, rows[columns]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("a", "b"), [(0.02, 0.12), (-0.05, -0.15)])
def test_a_straight_line_is_straight_and_where_the_intrinsics_say(
    lens: tuple[float, ...], a: float, b: float
) -> None:
    image = line_image(seen_slopes(lens), a, b)
    columns, rows = line_rows(image)
    bend = rows - np.polyval(np.polyfit(columns, rows, 1), columns)
    assert np.abs(bend).max() > 1.0
    rectifier = Rectifier(camera(lens), SIZE)
    new = rectifier.intrinsics
    assert new is not None
    columns, rows = line_rows(rectifier.image(image))
    assert len(columns) > 400
    slopes_x, slopes_y = (columns - new[0, 2]) / new[0, 0], (rows - new[1, 2]) / new[1, 1]
    inner = (columns > 5) & (columns < 634)
    error = (slopes_y - a * slopes_x - b) * new[1, 1]
    assert np.abs(error[inner]).max() < 0.15


@pytest.mark.parametrize("lens", LENSES)
def test_no_pixel_comes_from_outside_the_image(lens: tuple[float, ...]) -> None:
    """Each pixel of the image holds its own place; the places that come out are looked up."""
    x, y = np.meshgrid(np.arange(640.0), np.arange(192.0))
    rectifier = Rectifier(camera(lens), SIZE)
    new = rectifier.intrinsics
    assert new is not None
    pinhole = np.stack([x, y], axis=-1) - new[:2, 2]
    source = distort(pinhole / new[[0, 1], [0, 1]], np.array(lens)) * K[[0, 1], [0, 1]] + K[:2, 2]
    assert (source >= -0.5).all()
    assert (source <= [639.5, 191.5]).all()
    found = rectifier.depth(y.astype(np.float32))
    np.testing.assert_allclose(found, source[..., 1], atol=0.52)
    assert (new[[0, 1], [0, 1]] >= K[[0, 1], [0, 1]]).all()
    np.testing.assert_array_equal(new[:2, 2], K[:2, 2])


@pytest.mark.parametrize("lens", [lens for lens in LENSES if lens[0] > 0])
def test_no_more_is_cut_off_than_must_be(lens: tuple[float, ...]) -> None:
    new = Rectifier(camera(lens), SIZE).intrinsics
    assert new is not None
    corners = np.array([[0, 0], [639, 0], [0, 191], [639, 191.0]])
    focal = new[[0, 1], [0, 1]] * 0.999
    source = distort((corners - new[:2, 2]) / focal, np.array(lens)) * K[[0, 1], [0, 1]] + K[:2, 2]
    assert ((source < -0.5) | (source > [639.5, 191.5])).any()


@pytest.mark.parametrize("size", [SIZE, (96, 320), (150, 400), (288, 960)])
@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.0, 0.0), (1e-6, 0.0, 0.0, 0.0)])
def test_no_distortion_is_a_plain_resize(size: tuple[int, int], lens: tuple[float, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    rectifier = Rectifier(camera(lens), size)
    plain = Pillow.fromarray(image).resize(size[::-1], Pillow.Resampling.BICUBIC)
    np.testing.assert_array_equal(rectifier.image(image), np.asarray(plain))
    assert rectifier.intrinsics is not None
    np.testing.assert_allclose(rectifier.intrinsics, resize_intrinsics(K, SIZE, size))


def test_another_size_is_rectified_alike() -> None:
    """The calibration is for one size, the images that come out have another."""
    image = line_image(seen_slopes(LENSES[0]), 0.02, 0.12)
    small = Rectifier(camera(LENSES[0]), (96, 320))
    new = small.intrinsics
    assert new is not None
    columns, rows = line_rows(small.image(image))
    error = (rows - new[1, 2]) / new[1, 1] - 0.02 * (columns - new[0, 2]) / new[0, 0] - 0.12
    assert np.abs(error * new[1, 1]).max() < 0.2


def test_unknown_intrinsics_stay_unknown_and_images_are_resized() -> None:
    image = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    rectifier = Rectifier(Calibration(None, np.zeros(4), SIZE, "unknown"), (96, 320))
    assert rectifier.intrinsics is None
    assert rectifier.image(image).shape == (96, 320, 3)


@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.0, 0.0), LENSES[0]])
@pytest.mark.parametrize("size", [SIZE, (48, 160)])
def test_depth_keeps_its_values_and_unknown_stays_unknown(
    lens: tuple[float, ...], size: tuple[int, int]
) -> None:
    depth = np.random.default_rng(0).choice([2.0, 7.0, 30.0], SIZE).astype(np.float32)
    depth[:, :300] = np.nan
    out = Rectifier(camera(lens), size).depth(depth)
    assert out.shape == size
    assert set(np.unique(out[np.isfinite(out)])) == {2.0, 7.0, 30.0}
    border = 300 * size[1] // 640
    assert np.isnan(out[:, : border - 6]).all()
    assert np.isfinite(out[:, border + 6 :]).all()


def test_reduced_depth_is_that_of_the_pixels_middle() -> None:
    """A slope of depth shows half a pixel of shift."""
    depth = np.tile(np.arange(1, 641, dtype=np.float32), (192, 1))
    out = Rectifier(camera((0.0, 0.0, 0.0, 0.0)), (64, 128)).depth(depth)
    np.testing.assert_array_equal(out[0, :3], [3, 8, 13])


def test_a_distortion_that_no_lens_has_is_refused() -> None:
    with pytest.raises(DegenerateGeometryError, match=r"no lens has .* k1 = 500.*calibration"):
        Rectifier(camera((500.0, 0.0, 0.0, 0.0)), SIZE)


@pytest.mark.parametrize("intrinsics", [K, None])
def test_a_calibration_comes_back_from_its_file(tmp_path: Path, intrinsics: Array | None) -> None:
    path = tmp_path / "calibration.yaml"
    saved = Calibration(
        intrinsics, np.array([0.015936, -1 / 3, 1e-4, -2e-3]), SIZE, "given: refined, 19 “x”"
    )
    save_calibration(path, saved)
    loaded = load_calibration(path)
    np.testing.assert_equal(loaded.intrinsics, intrinsics)
    np.testing.assert_array_equal(loaded.distortion, saved.distortion)
    assert (loaded.size, loaded.source) == (SIZE, saved.source)


GOOD = "size: [192, 640]\nintrinsics: null\ndistortion: [0, 0, 0, 0]\nsource: x\n"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1, 2",
        "a list: of [things]",
        GOOD.replace("[192, 640]", "[192]"),
        GOOD.replace("[192, 640]", "[0, 640]"),
        GOOD.replace("[0, 0, 0, 0]", "[0, 0]"),
        GOOD.replace("[0, 0, 0, 0]", "[0, .nan, 0, 0]"),
        GOOD.replace("null", "[[1, 0], [0, 1]]"),
        GOOD.replace("null", "[[0, 0, 1], [0, 1, 1], [0, 0, 1]]"),
        GOOD.replace("source: x", ""),
    ],
)
def test_a_file_that_is_no_calibration_is_named_with_what_to_do(tmp_path: Path, text: str) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(GOOD)
    assert load_calibration(path).size == SIZE
    path.write_text(text)
    with pytest.raises(RunFolderError) as caught:
        load_calibration(path)
    assert str(caught.value) == f"{path} is no calibration: remove it to calibrate again"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"calibration\.yaml is no calibration"):
        load_calibration(tmp_path / "calibration.yaml")
