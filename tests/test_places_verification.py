"""Verification of two images: geometry that agrees, or a reason against it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rendered import RenderedDrive, seen_from
from views import street_views

from laser_slam.config import VerificationConfig
from laser_slam.places import Verification, find_features, verify
from laser_slam.sim3 import Array
from laser_slam.types import Image

CONFIG = VerificationConfig()
FIRST, SECOND = 2, 7  # frames of the drive, 4 m apart


def check(first: Image, second: Image, intrinsics: Array | None) -> Verification:
    return verify(find_features(first, CONFIG), find_features(second, CONFIG), intrinsics, CONFIG)


@pytest.fixture(scope="module")
def elsewhere() -> list[Image]:
    """Six views of another street."""
    return street_views()[::3]


@pytest.fixture(scope="module")
def verified(short_drive: RenderedDrive) -> Verification:
    images = short_drive.images
    return check(images[FIRST], images[SECOND], short_drive.intrinsics)


@pytest.mark.parametrize("is_known", [True, False])
@pytest.mark.parametrize("pair", [(2, 7), (7, 2), (0, 3), (12, 16)])
def test_two_views_of_one_place_pass(
    short_drive: RenderedDrive, pair: tuple[int, int], is_known: bool
) -> None:
    first, second = (short_drive.images[frame] for frame in pair)
    result = check(first, second, short_drive.intrinsics if is_known else None)
    assert result.rejected is None
    assert result.inlier_ratio > 0.7
    assert (result.second_from_first is not None) == is_known


def test_the_motion_is_the_true_one(short_drive: RenderedDrive, verified: Verification) -> None:
    poses = short_drive.world_from_cam
    true = np.linalg.inv(poses[SECOND]) @ poses[FIRST]
    assert verified.second_from_first is not None
    turn = verified.second_from_first[:3, :3].T @ true[:3, :3]
    assert np.degrees(np.arccos(min(1.0, (np.trace(turn) - 1) / 2))) < 0.5
    direction = true[:3, 3] / np.linalg.norm(true[:3, 3])
    assert verified.second_from_first[:3, 3] @ direction > np.cos(np.radians(3))


def test_inliers_are_where_the_same_points_truly_are(
    short_drive: RenderedDrive, verified: Verification
) -> None:
    true = seen_from(short_drive, FIRST, SECOND, verified.first_pixels)
    error = np.linalg.norm(true - verified.second_pixels, axis=1)
    known = error[np.isfinite(error)]
    assert len(known) >= 30
    assert np.median(known) < 1.0
    assert np.mean(known < 4.0) > 0.9


@pytest.mark.parametrize("is_known", [True, False])
def test_other_places_fail(
    short_drive: RenderedDrive, elsewhere: list[Image], is_known: bool
) -> None:
    intrinsics = short_drive.intrinsics if is_known else None
    for other in elsewhere:
        result = check(short_drive.images[FIRST], other, intrinsics)
        assert result.rejected is not None
        assert result.support < 0.75 * CONFIG.min_support


def test_pixels_are_those_of_the_image_as_it_was_given(short_drive: RenderedDrive) -> None:
    """An image twice as large has its points at twice the place: centres map to centres."""
    images = [short_drive.images[frame] for frame in (FIRST, SECOND)]
    large = [cv2.resize(image, (1280, 384), interpolation=cv2.INTER_CUBIC) for image in images]
    small, big = find_features(images[0], CONFIG), find_features(large[0], CONFIG)
    expected = 2 * small.pixels + 0.5
    gaps = np.linalg.norm(big.pixels[:, None] - expected[None], axis=2).min(axis=1)
    assert np.median(gaps) < 0.2
    intrinsics = short_drive.intrinsics * [[2], [2], [1]]
    intrinsics[:2, 2] += 0.5
    assert check(large[0], large[1], intrinsics).rejected is None


def test_images_may_differ_in_size(short_drive: RenderedDrive) -> None:
    half = cv2.resize(short_drive.images[SECOND], (512, 154), interpolation=cv2.INTER_AREA)
    result = check(short_drive.images[FIRST], half, None)
    assert result.rejected is None
    assert result.second_pixels[:, 0].max() < 512


@pytest.mark.parametrize("shade", [0, 255])
def test_blank_images_are_rejected_in_words(short_drive: RenderedDrive, shade: int) -> None:
    blank = np.full((192, 640, 3), shade, np.uint8)
    image = short_drive.images[0]
    for first, second in ((blank, blank), (blank, image), (image, blank)):
        result = check(first, second, short_drive.intrinsics)
        assert result.rejected is not None
        assert result.rejected.startswith("0 inliers count for 0 ")
        assert result.inlier_ratio == result.support == 0


def test_many_matches_on_one_object_are_no_place(short_drive: RenderedDrive) -> None:
    """A parked car of the same make: dozens of true matches, all in one part of the image."""
    first, second = (find_features(short_drive.images[i], CONFIG) for i in (FIRST, FIRST + 1))
    x, y = first.pixels.T
    is_on_it = (x < 200) & (y > 48)
    part = replace(first, pixels=first.pixels[is_on_it], descriptors=first.descriptors[is_on_it])
    result = verify(part, second, short_drive.intrinsics, CONFIG)
    assert result.num_inliers > 2 * CONFIG.min_support
    assert result.rejected is not None
    assert result.rejected.endswith("by their spread, need 30")
    assert verify(first, second, short_drive.intrinsics, CONFIG).rejected is None


def test_matches_that_disagree_are_no_place(short_drive: RenderedDrive) -> None:
    """Most features of a place, moved about in the image: many matches agree, more do not."""
    first, second = (find_features(short_drive.images[i], CONFIG) for i in (FIRST, FIRST + 1))
    chance = np.random.default_rng(0)
    pixels = first.pixels.copy()
    moved = chance.random(len(pixels)) < 0.8
    pixels[moved] = chance.permutation(pixels[moved])
    result = verify(replace(first, pixels=pixels), second, short_drive.intrinsics, CONFIG)
    assert result.support >= CONFIG.min_support
    assert result.rejected is not None
    assert result.rejected.startswith("inlier ratio 0.")


def test_the_same_images_always_give_the_same_verdict(short_drive: RenderedDrive) -> None:
    images = [short_drive.images[frame] for frame in (FIRST, SECOND)]
    one, two = (check(images[0], images[1], short_drive.intrinsics) for _ in range(2))
    np.testing.assert_array_equal(one.first_pixels, two.first_pixels)
    np.testing.assert_array_equal(one.second_pixels, two.second_pixels)
