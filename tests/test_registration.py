"""Registration finds the similarity between two views of one street, and says how sure it is."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_from_fov, rays
from laser_slam.config import RegistrationConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.registration import bridge, register
from laser_slam.registration.scale import SCALE_ESTIMATORS
from laser_slam.sim3 import Sim3, rotation_exp, rotation_log
from laser_slam.types import Prediction, Registration, WindowStatus

HEIGHT, WIDTH = 48, 160
CONFIG = RegistrationConfig()
Array = NDArray[np.float64]
# Planes of the street: normal and offset of n . p = d, in metres; y points down.
STREET = [((0, 1, 0), 1.6), ((1, 0, 0), 8.0), ((-1, 0, 0), 7.0), ((0, 0, 1), 60.0)]


def street_depth(world_from_cam: Array, intrinsics: Array) -> Array:
    """Ray-cast ground, two facades and an end wall: depth in metres."""
    directions = rays(intrinsics, HEIGHT, WIDTH) @ world_from_cam[:3, :3].T
    depth = np.full((HEIGHT, WIDTH), np.inf)
    for normal, offset in STREET:
        towards = directions @ np.array(normal, dtype=float)
        hit = (offset - world_from_cam[:3, 3] @ np.array(normal)) / np.where(
            towards > 1e-9, towards, np.nan
        )
        depth = np.fmin(depth, hit)
    return depth


def drive(frames: range, step: float = 0.8, turn: float = 0.01) -> Array:
    """Drive along the street, ``step`` metres and ``turn`` radians of yaw a frame."""
    world_from_cam = np.tile(np.eye(4), (len(frames), 1, 1))
    for pose, frame in zip(world_from_cam, frames, strict=True):
        pose[:3, :3] = rotation_exp(np.array([0.0, turn * frame, 0.0]))
        pose[:3, 3] = [0.05 * turn * frame**2, 0.0, step * frame]
    return world_from_cam


def view(
    frames: range, window_from_world: Sim3, world_from_cam: Array | None = None, fov: float = 80.0
) -> Prediction:
    """See some frames of the drive without an error, in the window's own frame and unit."""
    poses = drive(frames) if world_from_cam is None else world_from_cam
    intrinsics = intrinsics_from_fov(fov, HEIGHT, WIDTH)
    depth = np.array([street_depth(pose, intrinsics) for pose in poses])
    return Prediction(
        frames=np.arange(frames.start, frames.stop),
        depth=(window_from_world.scale * depth).astype(np.float32),
        confidence=np.ones_like(depth, dtype=np.float32),
        window_from_cam=window_from_world.apply_poses(poses),
        intrinsics=np.tile(intrinsics, (len(poses), 1, 1)),
    )


def random_sim3(rng: np.random.Generator, unit: float = 0.1) -> Sim3:
    return Sim3(
        unit * np.exp(rng.uniform(-1, 1)), rotation_exp(rng.normal(size=3)), rng.normal(size=3)
    )


def two_views(seed: int) -> tuple[Prediction, Prediction, Sim3]:
    """Return two windows with 5 common frames, and the true ``previous_from_current``."""
    rng = np.random.default_rng(seed)
    previous_from_world, current_from_world = random_sim3(rng), random_sim3(rng)
    previous = view(range(0, 10), previous_from_world)
    current = view(range(5, 15), current_from_world)
    return previous, current, previous_from_world @ current_from_world.inverse()


def disturb(
    window: Prediction, rng: np.random.Generator, poses: float = 1e-3, depth: float = 0.02
) -> Prediction:
    """Add noise: of poses (radians; share of the scene's depth), of depth (per pixel, relative).

    Half of the depth noise belongs to whole frames, as a backbone's does.
    """
    num = len(window.frames)
    noisy = np.array(window.window_from_cam)
    noisy[:, :3, :3] = rotation_exp(poses * rng.normal(size=(num, 3))) @ noisy[:, :3, :3]
    noisy[:, :3, 3] += poses * float(np.median(window.depth)) * rng.normal(size=(num, 3))
    log_noise = depth * (
        rng.normal(size=window.depth.shape) + 0.5 * rng.normal(size=(num, 1, 1))
    ).astype(np.float32)
    return dataclasses.replace(
        window,
        depth=window.depth * np.exp(log_noise).astype(np.float32),
        confidence=rng.uniform(0.01, 1, window.depth.shape).astype(np.float32),
        window_from_cam=noisy,
    )


def in_other_unit(window: Prediction, factor: float) -> Prediction:
    poses = np.array(window.window_from_cam)
    poses[:, :3, 3] *= factor
    return dataclasses.replace(
        window, depth=(window.depth * factor).astype(np.float32), window_from_cam=poses
    )


def errors(measured: Registration, truth: Sim3) -> Array:
    """Return the 7 errors in the order and units of ``Registration.sigmas``."""
    found = measured.previous_from_current
    return np.concatenate(
        [
            rotation_log(truth.rotation @ found.rotation.T),
            truth.translation - found.translation,
            [np.log(truth.scale / found.scale)],
        ]
    )


def settings(**kwargs: Any) -> RegistrationConfig:
    return RegistrationConfig(**kwargs)


@pytest.mark.parametrize("scale", sorted(SCALE_ESTIMATORS))
@pytest.mark.parametrize("anchor_length", ["balanced", "spread", "unit"])
def test_a_known_similarity_is_found(scale: str, anchor_length: str) -> None:
    for seed in range(4):
        previous, current, truth = two_views(seed)
        measured = register(previous, current, settings(scale=scale, anchor_length=anchor_length))
        np.testing.assert_allclose(errors(measured, truth), 0, atol=1e-5)
        assert measured.bridged is None
        assert measured.residual < 1e-5
        assert measured.num_pixels > 1000


def test_points_instead_of_anchors_find_a_known_similarity() -> None:
    previous, current, truth = two_views(1)
    measured = register(previous, current, settings(rigid="points"))
    np.testing.assert_allclose(errors(measured, truth), 0, atol=1e-5)


@pytest.mark.parametrize("factor", [0.01, 100.0])
@pytest.mark.parametrize("config", [{}, {"scale": "huber"}, {"scale": "l1"}, {"rigid": "points"}])
@pytest.mark.parametrize("anchor_length", ["balanced", "spread"])
def test_the_unit_of_a_window_changes_nothing_but_the_scale(
    factor: float, config: dict[str, Any], anchor_length: str
) -> None:
    rng = np.random.default_rng(3)
    previous, current, _ = two_views(3)
    previous, current = disturb(previous, rng), disturb(current, rng)
    chosen = settings(**config, anchor_length=anchor_length)
    plain = register(previous, current, chosen)
    for other, scale, length in (
        (register(previous, in_other_unit(current, factor), chosen), 1 / factor, 1.0),
        (register(in_other_unit(previous, factor), current, chosen), factor, factor),
    ):
        first, second = plain.previous_from_current, other.previous_from_current
        assert second.scale == pytest.approx(scale * first.scale, rel=1e-5)
        np.testing.assert_allclose(second.rotation, first.rotation, atol=1e-6)
        np.testing.assert_allclose(second.translation, length * first.translation, rtol=1e-4)
        units = np.repeat([1.0, length, 1.0], [3, 3, 1])
        np.testing.assert_allclose(other.sigmas, units * plain.sigmas, rtol=1e-3)
        assert other.num_pixels == plain.num_pixels


def test_swapping_the_windows_inverts_the_similarity() -> None:
    rng = np.random.default_rng(8)
    previous, current, _ = two_views(8)
    previous, current = disturb(previous, rng), disturb(current, rng)
    there = register(previous, current, CONFIG).previous_from_current
    back = register(current, previous, CONFIG).previous_from_current
    np.testing.assert_allclose((there @ back).matrix(), np.eye(4), atol=2e-4)


def scale_error(estimator: str, outliers: float, seed: int) -> float:
    """Make the farthest pixels 30 % too far, the defect that layers are for."""
    rng = np.random.default_rng(seed)
    previous, current, truth = two_views(seed)
    depth = disturb(current, rng, poses=0).depth
    limit = np.quantile(depth, 1 - outliers) if outliers else np.inf
    wrong = dataclasses.replace(current, depth=np.where(depth > limit, 1.3 * depth, depth))
    measured = register(previous, wrong, settings(scale=estimator))
    return abs(float(errors(measured, truth)[6]))


@pytest.mark.parametrize(
    ("outliers", "tolerance"), [(0.0, 0.01), (0.1, 0.015), (0.2, 0.025), (0.3, 0.04)]
)
def test_scale_survives_a_third_of_outliers(outliers: float, tolerance: float) -> None:
    assert max(scale_error("log_huber", outliers, seed) for seed in range(5)) < tolerance


def test_least_squares_does_not_survive_outliers() -> None:
    for outliers in (0.1, 0.3):
        robust = np.mean([scale_error("log_huber", outliers, seed) for seed in range(3)])
        plain = np.mean([scale_error("closed_form", outliers, seed) for seed in range(3)])
        assert plain > 4 * robust


def test_huber_and_l1_are_at_their_minimum() -> None:
    rng = np.random.default_rng(0)
    source = rng.lognormal(size=2000)
    target = 1.7 * source * np.exp(0.2 * rng.laplace(size=2000))
    bend = CONFIG.huber_delta * np.median(target)

    def huber_cost(scale: float) -> float:
        error = np.abs(scale * source - target)
        return float(np.where(error < bend, error**2 / 2, bend * (error - bend / 2)).sum())

    def l1_cost(scale: float) -> float:
        return float(np.abs(scale * source - target).sum())

    for name, cost in (("huber", huber_cost), ("l1", l1_cost)):
        best = SCALE_ESTIMATORS[name](source, target, CONFIG)
        assert cost(best) <= min(cost(best * 0.9999), cost(best * 1.0001))


def test_unknown_pixels_are_harmless() -> None:
    rng = np.random.default_rng(4)
    previous, current, truth = two_views(4)
    holed = []
    for window, unknown in ((previous, np.nan), (current, np.inf)):
        hole = rng.random(window.depth.shape) < 0.5
        confidence = np.where(hole, 0, window.confidence)
        depth = np.where(hole, unknown, window.depth)
        holed.append(dataclasses.replace(window, depth=depth, confidence=confidence))
    measured = register(holed[0], holed[1], CONFIG)
    np.testing.assert_allclose(errors(measured, truth), 0, atol=1e-5)


def test_only_pixels_that_both_windows_trust_vote() -> None:
    previous, current, truth = two_views(5)
    confidence = np.full_like(current.confidence, 0.9)
    confidence[:, :, :70] = 0.1
    depth = np.array(current.depth)
    depth[:, :, :70] *= 3
    lied = dataclasses.replace(current, depth=depth, confidence=confidence)
    measured = register(previous, lied, settings(scale="closed_form"))
    np.testing.assert_allclose(errors(measured, truth), 0, atol=1e-5)


def test_a_map_of_one_confidence_still_votes() -> None:
    previous, current, _ = two_views(5)
    flat = dataclasses.replace(current, confidence=np.full_like(current.confidence, 0.25))
    assert register(previous, flat, CONFIG).num_pixels == 5 * HEIGHT * WIDTH


def test_straight_driving_keeps_the_roll() -> None:
    rng = np.random.default_rng(6)
    straight = drive(range(15), turn=0.0)
    previous_from_world, current_from_world = random_sim3(rng), random_sim3(rng)
    truth = previous_from_world @ current_from_world.inverse()
    previous = disturb(view(range(0, 10), previous_from_world, straight[:10]), rng)
    current = disturb(view(range(5, 15), current_from_world, straight[5:]), rng)
    for anchor_length in ("balanced", "spread", "unit"):
        measured = register(previous, current, settings(anchor_length=anchor_length))
        forward = previous_from_world.rotation[:, 2]
        assert abs(errors(measured, truth)[:3] @ forward) < 0.01


def test_balanced_anchors_give_the_best_rotation() -> None:
    squares = {"balanced": 0.0, "spread": 0.0}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        previous, current, truth = two_views(seed)
        previous, current = disturb(previous, rng), disturb(current, rng)
        for length in squares:
            measured = register(previous, current, settings(anchor_length=length))
            squares[length] += float((errors(measured, truth)[:3] ** 2).sum())
    assert squares["balanced"] < 0.25 * squares["spread"]


def test_cameras_in_one_place_still_fix_the_rotation() -> None:
    rng = np.random.default_rng(7)
    poses = drive(range(10), step=0.0, turn=0.02)
    poses[:, :3, 3] = 0
    previous_from_world, current_from_world = random_sim3(rng), random_sim3(rng)
    truth = previous_from_world @ current_from_world.inverse()
    previous = view(range(10), previous_from_world, poses)
    current = view(range(10), current_from_world, poses)
    for length in ("balanced", "spread", "unit"):
        measured = register(previous, current, settings(anchor_length=length))
        np.testing.assert_allclose(errors(measured, truth), 0, atol=1e-5)


def test_one_wrong_camera_does_not_turn_the_window() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        previous, current, truth = two_views(seed)
        previous, current = disturb(previous, rng), disturb(current, rng)
        poses = np.array(current.window_from_cam)
        poses[2, :3, :3] = rotation_exp(0.2 * rng.normal(size=3)) @ poses[2, :3, :3]
        poses[2, :3, 3] += 0.3 * rng.normal(size=3)
        wrong = dataclasses.replace(current, window_from_cam=poses)
        off = errors(register(previous, wrong, CONFIG), truth)
        assert np.linalg.norm(off[:3]) < 5e-3


def normalised_errors(num_shared: int, noise: Callable[..., Prediction]) -> Array:
    """Return the root mean square of error / sigma over many windows, for each of the 7."""
    normalised = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        first, second = random_sim3(rng), random_sim3(rng)
        previous = noise(view(range(0, 10), first), rng)
        current = noise(view(range(10 - num_shared, 20 - num_shared), second), rng)
        measured = register(previous, current, CONFIG)
        assert (measured.sigmas > 0).all()
        normalised.append(errors(measured, first @ second.inverse()) / measured.sigmas)
    return np.asarray(np.sqrt(np.mean(np.square(normalised), axis=0)))


def drift(window: Prediction, rng: np.random.Generator) -> Prediction:
    """Let errors grow along the window, as those of an adjustment do."""
    num = len(window.frames)
    turn, move, log_depth = np.cumsum(5e-4 * rng.normal(size=(3, num, 3)), axis=1)
    noisy = np.array(window.window_from_cam)
    noisy[:, :3, :3] = rotation_exp(turn) @ noisy[:, :3, :3]
    noisy[:, :3, 3] += float(np.median(window.depth)) * move
    depth = window.depth * np.exp(10 * log_depth[:, :1, None]).astype(np.float32)
    return disturb(dataclasses.replace(window, depth=depth, window_from_cam=noisy), rng, 0, 0.01)


@pytest.mark.parametrize("num_shared", [1, 2, 5])
def test_sigmas_tell_the_size_of_the_errors(num_shared: int) -> None:
    normalised = normalised_errors(num_shared, disturb)
    assert (normalised > 0.2).all()
    assert (normalised < 2.0).all()


@pytest.mark.parametrize("num_shared", [1, 2, 5])
def test_sigmas_allow_for_errors_that_grow_along_a_window(num_shared: int) -> None:
    normalised = normalised_errors(num_shared, drift)
    assert (normalised > 0.3).all()
    assert (normalised < 3.0).all()


def test_noisier_windows_get_larger_sigmas() -> None:
    previous, current, _ = two_views(0)
    calm, wild = (
        register(
            disturb(previous, np.random.default_rng(1), poses=noise, depth=10 * noise),
            disturb(current, np.random.default_rng(2), poses=noise, depth=10 * noise),
            CONFIG,
        )
        for noise in (1e-3, 1e-2)
    )
    assert (wild.sigmas > 2 * calm.sigmas).all()
    assert wild.residual > 5 * calm.residual


def test_cameras_of_another_focal_length_are_compared_by_range() -> None:
    rng = np.random.default_rng(0)
    world = random_sim3(rng)
    previous = view(range(0, 10), world)
    current = view(range(5, 15), Sim3())
    wrong = dataclasses.replace(
        current, intrinsics=view(range(1), Sim3(), fov=82.0).intrinsics[[0] * 10]
    )
    right = register(previous, current, CONFIG).previous_from_current.scale
    measured = register(previous, wrong, CONFIG).previous_from_current.scale
    assert 0.98 * right < measured < right  # a wider view makes ranges longer, by up to 1.3 %


def test_windows_without_a_common_frame_are_refused() -> None:
    previous, current = view(range(0, 5), Sim3()), view(range(7, 12), Sim3())
    with pytest.raises(DegenerateGeometryError) as error:
        register(previous, current, CONFIG)
    assert str(error.value) == (
        "windows of frames 0-4 and 7-11 share no frames; raise windows.overlap"
    )


def test_windows_with_few_common_pixels_are_refused() -> None:
    previous, current, _ = two_views(0)
    confidence = np.zeros_like(current.confidence)
    confidence[1, 20, 30:33] = 1
    blind = dataclasses.replace(current, confidence=confidence)
    with pytest.raises(DegenerateGeometryError) as error:
        register(previous, blind, CONFIG)
    assert str(error.value) == (
        "windows of frames 0-9 and 5-14 share 3 confident pixels, need 100; "
        "lower registration.min_pixels or raise windows.overlap"
    )


def blinded(window: Prediction, status: WindowStatus, poses: Array | None = None) -> Prediction:
    """Take depth and, unless given, motion from a window."""
    still = np.tile(np.eye(4), (len(window.frames), 1, 1)) if poses is None else poses
    return dataclasses.replace(
        window,
        depth=np.full_like(window.depth, np.nan),
        confidence=np.zeros_like(window.confidence),
        window_from_cam=still,
        status=status,
    )


def check_guess(guess: Registration, reason: str) -> None:
    assert guess.bridged == reason
    assert guess.num_pixels == 0
    assert np.isnan(guess.residual)
    assert np.isfinite(guess.previous_from_current.matrix()).all()
    assert guess.sigmas.shape == (7,)
    assert (guess.sigmas >= 0.1).all()


@pytest.mark.parametrize("status", [WindowStatus.STATIC, WindowStatus.FAILED])
def test_a_blind_window_lands_where_the_shared_frames_are(status: WindowStatus) -> None:
    previous, current, _ = two_views(2)
    with pytest.raises(DegenerateGeometryError, match="share 0 confident pixels"):
        register(previous, blinded(current, status), CONFIG)
    guess = bridge(previous, blinded(current, status), "standstill")
    check_guess(guess, "standstill")
    place = guess.previous_from_current
    assert place.scale == 1
    centers = previous.window_from_cam[5:, :3, 3]
    np.testing.assert_allclose(place.translation, centers.mean(axis=0), atol=1e-9)
    turns = rotation_log(previous.window_from_cam[5:, :3, :3] @ place.rotation.T)
    assert np.abs(turns).max() < 0.03  # the drive turns 0.01 a frame


def test_a_window_after_a_blind_one_is_placed_too() -> None:
    previous, current, _ = two_views(2)
    guess = bridge(blinded(previous, WindowStatus.FAILED), current, "blank frames")
    check_guess(guess, "blank frames")
    centers = guess.previous_from_current.apply(current.window_from_cam[:5, :3, 3])
    np.testing.assert_allclose(centers.mean(axis=0), 0, atol=1e-9)


def test_a_turn_on_the_spot_keeps_its_rotation() -> None:
    previous, _, _ = two_views(2)
    poses = np.array(drive(range(5, 15), step=0.0))
    poses[:, :3, 3] = 0
    turning = blinded(view(range(5, 15), Sim3()), WindowStatus.ROTATION, poses)
    guess = bridge(previous, turning, "rotation only").previous_from_current
    true = previous.window_from_cam[5:, :3, :3] @ np.swapaxes(poses[:5, :3, :3], 1, 2)
    np.testing.assert_allclose(guess.rotation, true[0], atol=1e-6)


def test_a_guess_takes_the_scale_from_two_paths() -> None:
    previous, current, truth = two_views(9)
    dark = dataclasses.replace(current, confidence=np.zeros_like(current.confidence))
    guess = bridge(previous, dark, "too dark")
    check_guess(guess, "too dark")
    np.testing.assert_allclose(guess.previous_from_current.matrix(), truth.matrix(), atol=1e-6)


def test_a_guess_without_common_frames_continues_where_the_previous_window_ends() -> None:
    rng = np.random.default_rng(0)
    previous, current = view(range(0, 5), random_sim3(rng)), view(range(7, 12), random_sim3(rng))
    guess = bridge(previous, current, "no overlap")
    check_guess(guess, "no overlap")
    placed = guess.previous_from_current.apply_poses(current.window_from_cam)
    np.testing.assert_allclose(placed[0], previous.window_from_cam[-1], atol=1e-9)
