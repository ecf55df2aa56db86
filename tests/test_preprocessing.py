"""Images as the networks were fed with them: sizes and pixels against those of the originals."""

import json

import golden
import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.backbones.feedforward import network_size
from laser_slam.camera import intrinsics_matrix, project, resize_intrinsics
from laser_slam.config.networks import NetworkConfig
from laser_slam.rectification import Rectifier, resize_image
from laser_slam.types import NO_DISTORTION, Calibration, Image

FOLDER = golden.DATA / "preprocess"
SIZES = json.loads((FOLDER / "sizes.json").read_text())
SIDE, PIXELS = NetworkConfig().side, NetworkConfig().num_pixels


def parse(name: str) -> tuple[int, int]:
    """Return (height, width) of ``<width>x<height>``."""
    width, height = name.split("x")
    return int(height), int(width)


def source(size: tuple[int, int]) -> Image:
    image = golden.make_images(21, 1, *size)[0].transpose(1, 2, 0)
    return np.asarray(np.floor(image * 255 + 0.5), np.uint8)


@pytest.mark.parametrize("name", SIZES)
def test_both_rules_give_the_originals_sizes(name: str) -> None:
    size = parse(name)
    assert network_size(size, "pixels", PIXELS) == tuple(SIZES[name]["pixels"][::-1])
    if size[0] <= size[1]:
        assert network_size(size, "side", SIDE) == tuple(SIZES[name]["side"][::-1])


def test_an_upright_image_is_turned_small_and_not_cut() -> None:
    """The original would make 518x690 of it and keep the middle 518 rows."""
    assert network_size((640, 480), "side", SIDE) == (518, 392)


@pytest.mark.parametrize("rule", ["side", "pixels"])
def test_any_size_becomes_whole_patches_of_about_its_aspect(rule: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        size = (int(rng.integers(100, 3000)), int(rng.integers(100, 3000)))
        limit = SIDE if rule == "side" else PIXELS
        height, width = network_size(size, rule, limit)
        assert height % 14 == 0
        assert width % 14 == 0
        # each side is rounded to a patch, and the pixel rule may take one more off
        steps = 0.5 if rule == "side" else 1.5
        slack = (1 + steps * 14 / min(height, width)) ** 2
        assert 1 / slack < (width / height) / (size[1] / size[0]) < slack
        assert (max(height, width) == SIDE) if rule == "side" else (height * width <= PIXELS)


@pytest.mark.parametrize("rule", ["side", "pixels"])
def test_what_was_resized_is_not_resized_again(rule: str) -> None:
    """Loop windows are predicted from the images of stored windows."""
    rng = np.random.default_rng(1)
    limit = SIDE if rule == "side" else PIXELS
    for size in [(376, 1241), *rng.integers(300, 2400, (300, 2)).tolist()]:
        once = network_size((size[0], size[1]), rule, limit)
        assert network_size(once, rule, limit) == once


@pytest.mark.parametrize("name", ["1241x376", "480x640"])
def test_pixels_are_those_of_the_original_to_the_grey_level(name: str) -> None:
    with np.load(FOLDER / "resized.npz") as file:
        expected: NDArray[np.uint8] = file[name]
    size = parse(name)
    width, height = SIZES[name]["side"]
    whole = round(size[0] * width / size[1] / 14) * 14
    cut = (whole - height) // 2
    found = resize_image(source(size), (whole, width))[cut : cut + height]
    np.testing.assert_array_equal(found.transpose(2, 0, 1)[:, ::7, ::7], expected)


def test_a_rectifier_resizes_pixels_as_the_network_wants_them_and_intrinsics_per_axis() -> None:
    size = (376, 1241)
    K = intrinsics_matrix(718.9, 718.9, 607.2, 185.2)
    small = network_size(size, "side", SIDE)
    rectifier = Rectifier(Calibration(K, NO_DISTORTION, size, "given"), small)
    np.testing.assert_array_equal(rectifier.image(source(size)), resize_image(source(size), small))
    assert rectifier.intrinsics is not None
    np.testing.assert_allclose(rectifier.intrinsics, resize_intrinsics(K, size, small))
    assert rectifier.intrinsics[0, 0] / rectifier.intrinsics[1, 1] == pytest.approx(
        (518 / 1241) / (154 / 376)
    )


def test_a_point_is_seen_at_the_same_place_of_the_small_image() -> None:
    """A bright spot moves by resizing to where the resized intrinsics put it."""
    size, K = (376, 1241), intrinsics_matrix(718.9, 718.9, 607.2, 185.2)
    point = np.array([4.0, -1.5, 12.0])
    u, v = project(point, K)
    x, y = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    spot = 250 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 6.0**2))
    image = np.repeat(spot[..., None], 3, axis=2).astype(np.uint8)
    rectifier = Rectifier(Calibration(K, NO_DISTORTION, size, "given"), (154, 518))
    small = rectifier.image(image)[..., 0].astype(float)
    rows, columns = np.indices(small.shape)
    found = np.array([(columns * small).sum(), (rows * small).sum()]) / small.sum()
    assert rectifier.intrinsics is not None
    np.testing.assert_allclose(found, project(point, rectifier.intrinsics), atol=0.05)


def test_an_image_of_the_right_size_is_not_touched() -> None:
    image = source((28, 42))
    assert resize_image(image, (28, 42)) is image
