"""The pinhole camera: projection inverts unprojection, and resizing moves no ray."""

import cv2
import numpy as np
import pytest

from laser_slam.camera import (
    distort,
    guess_intrinsics,
    intrinsics_from_fov,
    intrinsics_matrix,
    project,
    rays,
    resize_intrinsics,
    unproject,
)

K = intrinsics_matrix(100.0, 110.0, 31.0, 22.5)
HEIGHT, WIDTH = 48, 64


def test_projection_inverts_unprojection() -> None:
    depth = np.random.default_rng(0).uniform(0.1, 90, (HEIGHT, WIDTH)).astype(np.float32)
    pixels = project(unproject(depth, K), K)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-9)


def test_depth_is_z_and_not_the_length_of_the_ray() -> None:
    depth = np.full((HEIGHT, WIDTH), 7.0, dtype=np.float32)
    points = unproject(depth, K)
    np.testing.assert_array_equal(points[..., 2], 7.0)
    assert np.linalg.norm(points, axis=-1).max() > 7.1
    np.testing.assert_array_equal(rays(K, HEIGHT, WIDTH)[..., 2], 1.0)


def test_axes_are_right_down_forward() -> None:
    points = unproject(np.ones((HEIGHT, WIDTH), np.float32), K)
    assert points[0, -1, 0] > 0 > points[0, 0, 0]
    assert points[-1, 0, 1] > 0 > points[0, 0, 1]
    assert project(np.array([0.1, 0.0, 1.0]), K)[0] > K[0, 2]
    assert project(np.array([0.0, 0.1, 1.0]), K)[1] > K[1, 2]


def test_unknown_depth_gives_unknown_points_there_only() -> None:
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    depth[3, 4] = np.nan
    unknown = np.isnan(unproject(depth, K))
    assert unknown[3, 4].all()
    assert unknown.sum() == 3


@pytest.mark.parametrize("z", [0.0, -2.0, np.nan])
def test_what_is_not_in_front_has_no_pixel(z: float) -> None:
    pixels = project(np.array([[1.0, 2.0, z], [0.0, 0.0, 1.0]]), K)
    assert np.isnan(pixels[0]).all()
    np.testing.assert_allclose(pixels[1], K[:2, 2])


@pytest.mark.parametrize("new_size", [(24, 32), (96, 128), (30, 50), (48, 64)])
def test_resizing_keeps_the_rays_of_the_images_edges(new_size: tuple[int, int]) -> None:
    """An image spans -0.5 to width - 0.5, whatever its size."""
    resized = resize_intrinsics(K, (HEIGHT, WIDTH), new_size)
    for u, v in ((0.0, 0.0), (1.0, 1.0), (0.3, 0.7)):
        before = np.linalg.solve(K, [u * WIDTH - 0.5, v * HEIGHT - 0.5, 1])
        after = np.linalg.solve(resized, [u * new_size[1] - 0.5, v * new_size[0] - 0.5, 1])
        np.testing.assert_allclose(before, after, atol=1e-12)


def test_resizing_there_and_back_changes_nothing() -> None:
    many = np.stack([K, 2 * K])
    many[1, 2, 2] = 1
    there = resize_intrinsics(many, (HEIGHT, WIDTH), (100, 33))
    np.testing.assert_allclose(resize_intrinsics(there, (100, 33), (HEIGHT, WIDTH)), many)


@pytest.mark.parametrize("fov_deg", [30.0, 75.0, 120.0])
def test_the_field_of_view_spans_the_image(fov_deg: float) -> None:
    intrinsics = intrinsics_from_fov(fov_deg, HEIGHT, WIDTH)
    left = np.linalg.solve(intrinsics, [-0.5, 0, 1])[0]
    right = np.linalg.solve(intrinsics, [WIDTH - 0.5, 0, 1])[0]
    assert np.degrees(np.arctan(right) - np.arctan(left)) == pytest.approx(fov_deg, abs=1e-6)
    assert intrinsics[0, 0] == intrinsics[1, 1]
    middle = np.linalg.solve(intrinsics, [(WIDTH - 1) / 2, (HEIGHT - 1) / 2, 1])
    np.testing.assert_allclose(middle, [0, 0, 1], atol=1e-12)


def test_distortion_is_that_of_opencv() -> None:
    slopes = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    distortion = np.array([-0.21, 0.07, 0.003, -0.02])
    points = np.column_stack([slopes, np.ones(50)])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0]
    np.testing.assert_allclose(distort(slopes, distortion), theirs.reshape(-1, 2), atol=1e-12)
    np.testing.assert_array_equal(distort(slopes, np.zeros(4)), slopes)


def test_a_guess_has_square_pixels_and_its_centre_in_the_middle() -> None:
    guess = guess_intrinsics(100, 201, 0.5)
    np.testing.assert_array_equal(guess, intrinsics_matrix(100.5, 100.5, 100.0, 49.5))
    assert 0.4 < guess_intrinsics(100, 200)[0, 0] / 200 < 1.0
