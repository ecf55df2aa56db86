"""One camera for a window, of its points or of its frames' cameras, however wild some are."""

from typing import Any

import numpy as np
import pytest
from perfect import FOCALS, SIZE, camera

from laser_slam.backbones.feedforward import fit_camera, window_camera
from laser_slam.camera import rays

CENTRE = ((SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2)


def cloud(seed: int, unit: float = 1.0) -> tuple[Any, Any]:
    """Return points on the rays of the corridor's camera, and confidence."""
    rng = np.random.default_rng(seed)
    depth = unit * np.exp(rng.normal(size=(3, *SIZE)))
    points = rays(camera(CENTRE), *SIZE) * depth[..., None]
    return points.astype(np.float32), np.full(depth.shape, 0.5, np.float32)


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_a_camera_is_found_in_any_unit_with_one_focal_length_for_each_axis(unit: float) -> None:
    points, confidence = cloud(0, unit)
    K = fit_camera(points, confidence, CENTRE)
    assert K is not None
    np.testing.assert_allclose(K, camera(CENTRE), rtol=1e-5)


def test_a_camera_survives_a_third_of_wild_points_and_noise() -> None:
    points, confidence = cloud(1)
    rng = np.random.default_rng(2)
    points[..., :2] += 0.01 * points[..., 2:] * rng.normal(size=points[..., :2].shape)
    wild = rng.random(confidence.shape) < 0.3
    points[wild] = 3 * rng.normal(size=(int(wild.sum()), 3))
    K = fit_camera(points, confidence, CENTRE)
    assert K is not None
    np.testing.assert_allclose(K[[0, 1], [0, 1]], FOCALS, rtol=0.01)


def test_a_camera_listens_to_confident_pixels() -> None:
    points, confidence = cloud(3)
    points[:, :, :40, :2] *= 2  # another focal length, in less than half of the pixels
    points[:, :, 40:60, :2] *= 3
    confidence[:, :, :60] = 0.2
    K = fit_camera(points, confidence, CENTRE)
    assert K is not None
    np.testing.assert_allclose(K[[0, 1], [0, 1]], FOCALS, rtol=1e-4)


def test_what_no_pinhole_camera_sees_has_none() -> None:
    points, confidence = cloud(4)
    assert (
        fit_camera(points * np.array([-1, 1, 1], np.float32), confidence, CENTRE) is None
    )  # mirrored
    assert (
        fit_camera(points * np.array([1e-3, 1, 1], np.float32), confidence, CENTRE) is None
    )  # all ahead
    assert fit_camera(np.full_like(points, np.nan), confidence, CENTRE) is None
    assert fit_camera(points, np.zeros_like(confidence), CENTRE) is None
    assert fit_camera(points[:, :2, :2], confidence[:, :2, :2], (0.5, 0.5)) is None


def test_a_window_has_the_camera_that_most_frames_agree_on() -> None:
    cameras = np.tile(camera(CENTRE), (7, 1, 1))
    cameras[1, 0, 0] *= 3
    cameras[2] = np.nan
    cameras[3, 1, 1] = 0
    found = window_camera(cameras)
    assert found is not None
    np.testing.assert_allclose(found, camera(CENTRE))
    assert window_camera(cameras[2:4]) is None
