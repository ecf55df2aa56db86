"""Refined patches: noisy tracks come back, and a road that comes nearer does not pull them."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rendered import RenderedDrive, seen_from

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.refinement import refine
from laser_slam.camera import intrinsics_matrix
from laser_slam.sim3 import Array

RADIUS = 5
FRAMES = (2, 3, 4, 5, 6)  # of the rendered drive; tracks are made for the middle one
ROAD_K = intrinsics_matrix(370.0, 370.0, 319.5, 60.0)
ROAD_STEPS_M = (0.0, 1.0, 2.0)
HEIGHT_M = 1.65
NOISE_PX = 0.5


def blurred(images: list[NDArray[np.uint8]]) -> NDArray[np.float32]:
    return np.stack([cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7) for image in images])


def flat(K: Array) -> Array:
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.zeros(4)])


def make_bundle(R: Array, t: Array, points: Array, pixels: Array, K: Array) -> Bundle:
    """Every camera sees every point; pixels (P, C, 2)."""
    num, cams = pixels.shape[:2]
    cameras = np.tile(np.arange(cams), num)
    starts = np.arange(num + 1) * cams
    is_fixed = np.ones(cams, bool)
    return Bundle(R, t, points, cameras, starts, pixels.reshape(-1, 2), is_fixed, flat(K))


def street_bundle(drive: RenderedDrive) -> tuple[Bundle, NDArray[np.float32]]:
    """Take corners whose true places in all frames are known."""
    middle = FRAMES[len(FRAMES) // 2]
    grey = drive.greys[middle]
    corners = cv2.goodFeaturesToTrack(grey[20:-20, 20:-20], 500, 0.01, 8, blockSize=5)
    corners = corners.reshape(-1, 2).astype(np.float64) + 20
    pixels = np.stack([seen_from(drive, middle, frame, corners) for frame in FRAMES], axis=1)
    kept = np.isfinite(pixels).all(axis=(1, 2))
    corners, pixels = corners[kept], pixels[kept]
    x, y = corners.astype(int).T
    z = drive.depths[middle, y, x].astype(np.float64)
    rays = np.linalg.solve(drive.intrinsics, np.vstack([corners.T, np.ones(len(x))])).T
    world_from_cam = drive.world_from_cam[middle]
    points = (rays * z[:, None]) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    cam_from_world = np.asarray(np.linalg.inv(drive.world_from_cam[list(FRAMES)]), np.float64)
    R, t = cam_from_world[:, :3, :3].copy(), cam_from_world[:, :3, 3].copy()
    images = blurred([drive.greys[frame] for frame in FRAMES])
    return make_bundle(R, t, points, pixels, drive.intrinsics), images


def rms(error: Array) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def test_noise_of_tracks_falls_to_a_third_and_no_direction_is_preferred(
    short_drive: RenderedDrive,
) -> None:
    bundle, images = street_bundle(short_drive)
    true, is_reference = bundle.pixels.copy(), bundle.cameras == len(FRAMES) // 2
    assert is_reference.sum() > 100
    noise = np.random.default_rng(0).normal(0, NOISE_PX, true.shape)
    bundle.pixels += np.where(is_reference[:, None], 0.0, noise)
    before = bundle.pixels.copy()
    found = refine(bundle, images, RADIUS)
    np.testing.assert_array_equal(bundle.pixels[is_reference], true[is_reference])
    np.testing.assert_array_equal(bundle.pixels[~found], before[~found])
    assert found.mean() > 0.8
    moved = found & ~is_reference
    error, noise = (bundle.pixels - true)[moved], (before - true)[moved]
    lengths = np.linalg.norm(error, axis=1)
    settled = lengths < np.percentile(lengths, 90)  # the rest lies at edges of depth
    assert rms(error[settled]) < rms(noise) / 3
    assert np.abs(np.median(error, axis=0)).max() < 0.05


def test_rough_geometry_is_enough(short_drive: RenderedDrive) -> None:
    """Poses and depths err as they do before the last adjustment: 2 % of depth, 2 cm."""
    bundle, images = street_bundle(short_drive)
    true, rng = bundle.pixels.copy(), np.random.default_rng(1)
    bundle.translations += rng.normal(0, 0.01, bundle.translations.shape)
    found = refine(bundle, images, RADIUS) & (bundle.cameras != len(FRAMES) // 2)
    assert np.median(np.linalg.norm(bundle.pixels - true, axis=1)[found]) < 0.2


def test_patches_without_texture_are_lost_and_other_scenes_not_found(
    short_drive: RenderedDrive,
) -> None:
    bundle, images = street_bundle(short_drive)
    pixels = bundle.pixels.copy()
    assert not refine(bundle, np.full_like(images, 90), RADIUS).any()
    np.testing.assert_array_equal(bundle.pixels, pixels)
    other = images.copy()
    other[0] = np.random.default_rng(0).uniform(0, 255, other[0].shape)
    found = refine(bundle, other, RADIUS)
    assert found[bundle.cameras == 0].mean() < 0.1
    assert found[bundle.cameras == 3].mean() > 0.6


def test_patches_of_stripes_and_steps_are_no_crash() -> None:
    """Flat cells with jumps between them have no gradient where they are sampled."""
    K, rng = ROAD_K, np.random.default_rng(0)
    steps = np.kron(rng.integers(0, 2, (24, 80)), np.ones((8, 8))).astype(np.float32) * 200
    points = np.stack(
        [rng.uniform(-3, 3, 400), rng.uniform(-0.5, 2, 400), rng.uniform(4, 9, 400)], 1
    )
    R, t = np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))
    t[:, 2] = -np.array(ROAD_STEPS_M)
    pixels = np.stack([place(points - [0, 0, step]) for step in ROAD_STEPS_M], axis=1)
    bundle = make_bundle(R, t, points, np.rint(pixels), K)
    refine(bundle, np.stack([steps] * 3), RADIUS)
    assert np.isfinite(bundle.pixels).all()


def place(points: Array) -> Array:
    slopes = points[..., :2] / points[..., 2:]
    return np.asarray(slopes * ROAD_K[[0, 1], [0, 1]] + ROAD_K[:2, 2])


def road_image(forward_m: float) -> NDArray[np.uint8]:
    """A textured plane below the camera; its texture is smooth at every distance looked at."""
    y, x = np.mgrid[0:192, 0:640].astype(np.float64)
    z = HEIGHT_M * ROAD_K[1, 1] / np.maximum(y - ROAD_K[1, 2], 8.0)
    right = (x - ROAD_K[0, 2]) / ROAD_K[0, 0] * z
    rng, image = np.random.default_rng(5), np.zeros_like(x)
    for _ in range(60):
        angle, length = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(0.5), np.log(3)))
        k = 2 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
        image += np.sin(k[0] * right + k[1] * (z + forward_m) + rng.uniform(0, 2 * np.pi))
    return np.asarray(np.clip(128 + 12 * image, 0, 255), np.uint8)


@pytest.mark.parametrize("patch", [11, 21])
def test_a_road_that_comes_nearer_pulls_plain_tracking_and_not_refined(patch: int) -> None:
    """The flow inside a patch is not even, nor is its texture: its mean is not the centre's."""
    images = [road_image(step) for step in ROAD_STEPS_M]
    rng = np.random.default_rng(0)
    points = np.stack(
        [rng.uniform(-3, 3, 300), np.full(300, HEIGHT_M), rng.uniform(6.5, 10, 300)], axis=1
    )
    pixels = np.stack([place(points - [0, 0, step]) for step in ROAD_STEPS_M], axis=1)
    start = pixels[:, 1].astype(np.float32)
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        images[1],
        images[2],
        start,
        pixels[:, 2].astype(np.float32),
        winSize=(patch, patch),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    plain = (end - pixels[:, 2])[found.ravel() == 1][:, 1]
    R, t = np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))
    t[:, 2] = -np.array(ROAD_STEPS_M)
    bundle = make_bundle(
        R, t, points, pixels + rng.normal(0, 0.3, pixels.shape) * np.array([[0], [0], [1]]), ROAD_K
    )
    found = refine(bundle, blurred(images), RADIUS).reshape(-1, 3)[:, 2]
    refined = (bundle.pixels.reshape(-1, 3, 2)[:, 2] - pixels[:, 2])[found][:, 1]
    assert found.mean() > 0.8
    assert abs(np.median(plain)) > 0.1
    assert abs(np.median(refined)) < 0.1 * abs(np.median(plain))
