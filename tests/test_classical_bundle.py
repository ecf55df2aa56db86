"""Bundle adjustment: it finds the truth from tracks, and its equations are those on paper."""

from dataclasses import replace

import numpy as np
import pytest
from tracks import Drive, camera_centres

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.bundle_kernels import eliminate_points, linearise
from laser_slam.backbones.classical.calibration_kernels import (
    NUM_SHARED,
    shared_equations,
    shared_jacobian,
)
from laser_slam.sim3 import Array, rotation_exp, rotation_log

DRIVE = Drive(num_frames=10, turn_deg=20, num_points=600)
LENS = np.array([700.0, 710.0, 600.0, 180.0, -0.2, 0.08, 0.004, -0.02])
NO_LOSS = 1e9  # pixels: the Huber loss stays quadratic


def shake(bundle: Bundle, seed: int = 0) -> None:
    """Move free cameras and all points off the truth."""
    rng, free = np.random.default_rng(seed), ~bundle.is_fixed
    num = int(free.sum())
    bundle.rotations[free] = rotation_exp(rng.normal(0, 0.01, (num, 3))) @ bundle.rotations[free]
    bundle.translations[free] += rng.normal(0, 0.1, (num, 3))
    bundle.points *= 1 + rng.normal(0, 0.03, (len(bundle.points), 1))


def errors(bundle: Bundle, drive: Drive) -> tuple[float, float]:
    """Return the largest error of a centre in metres and of a rotation in radians."""
    centres = camera_centres(bundle.rotations, bundle.translations)
    turned = bundle.rotations @ drive.rotations.transpose(0, 2, 1)
    return (
        float(np.linalg.norm(centres - drive.centres, axis=1).max()),
        float(np.linalg.norm(rotation_log(turned), axis=1).max()),
    )


def adjusted(drive: Drive, huber_px: float = NO_LOSS) -> tuple[float, float]:
    bundle, _ = drive.bundle(fixed=(0, drive.num_frames - 1))
    shake(bundle)
    bundle.adjust(huber_px, 40)
    return errors(bundle, drive)


@pytest.mark.parametrize("seed", range(3))
def test_poses_and_points_come_back_exactly_without_noise(seed: int) -> None:
    drive = replace(DRIVE, noise_px=0.0, seed=seed)
    bundle, ids = drive.bundle(fixed=(0, 9))
    shake(bundle, seed)
    assert errors(bundle, drive)[0] > 0.1
    for _ in range(3):
        cost = bundle.adjust(1.0, 40)
    assert cost < 1e-9
    assert max(errors(bundle, drive)) < 1e-5
    np.testing.assert_allclose(bundle.points, drive.points[ids], rtol=1e-3, atol=1e-3)


def test_distorted_tracks_need_the_lens_and_then_give_the_truth() -> None:
    drive = replace(DRIVE, noise_px=0.0, distortion=np.array([-0.1, 0.03, 0.002, -0.003]))
    bundle, _ = drive.bundle(fixed=(0, 9))
    shake(bundle)
    for _ in range(3):
        bundle.adjust(1.0, 40)
    assert max(errors(bundle, drive)) < 1e-5
    bundle.intrinsics[4:] = 0.0
    assert bundle.adjust(1.0, 40) > 0.01


def test_errors_are_in_proportion_to_the_noise_and_residuals_at_its_level() -> None:
    little, much = adjusted(replace(DRIVE, noise_px=0.1)), adjusted(replace(DRIVE, noise_px=0.4))
    np.testing.assert_allclose(np.array(much) / little, 4, rtol=0.1)
    bundle, _ = DRIVE.bundle(fixed=(0, 9))
    bundle.adjust(NO_LOSS, 40)
    num = 2 * len(bundle.cameras)
    freedom = num - 3 * len(bundle.points) - 6 * 8
    rms = np.sqrt((bundle.residuals() ** 2).sum() / freedom)
    assert rms == pytest.approx(DRIVE.noise_px, rel=5 / np.sqrt(2 * freedom))


@pytest.mark.parametrize("is_wild", [False, True])
def test_the_cost_never_rises(is_wild: bool) -> None:
    bundle, _ = replace(DRIVE, outliers=0.1).bundle(fixed=(0,))
    shake(bundle)
    if is_wild:  # many points behind their cameras
        bundle.points += np.random.default_rng(0).normal(0, 8, bundle.points.shape)
    in_front = np.isfinite(bundle.residuals())
    start_px = np.median(bundle.residuals()[in_front])
    assert in_front.all() is not np.bool_(is_wild)
    costs = [bundle.adjust(1.0, 0)] + [bundle.adjust(1.0, 1) for _ in range(12)]
    assert np.isfinite(costs).all()
    assert (np.diff(costs) <= 1e-12 * np.array(costs[:-1])).all()
    assert np.median(bundle.residuals()[in_front]) < 0.1 * start_px


def test_fixed_cameras_do_not_move_and_the_others_do() -> None:
    bundle, _ = DRIVE.bundle(fixed=(0, 4, 9))
    shake(bundle)
    R, t = bundle.rotations.copy(), bundle.translations.copy()
    bundle.adjust(1.0, 10)
    np.testing.assert_array_equal(bundle.rotations[bundle.is_fixed], R[bundle.is_fixed])
    np.testing.assert_array_equal(bundle.translations[bundle.is_fixed], t[bundle.is_fixed])
    assert np.abs(bundle.translations - t)[~bundle.is_fixed].max(axis=1).min() > 1e-3


def test_a_tenth_of_outliers_hardly_matters_to_huber() -> None:
    clean = adjusted(replace(DRIVE, num_points=2000), 1.0)
    robust = adjusted(replace(DRIVE, num_points=2000, outliers=0.1), 1.0)
    naive = adjusted(replace(DRIVE, num_points=2000, outliers=0.1), NO_LOSS)
    assert robust[0] < 3 * clean[0]
    assert naive[0] > 3 * robust[0]


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_the_unit_of_length_changes_only_the_scale(unit: float) -> None:
    results = []
    for factor in (1.0, unit):
        bundle, _ = DRIVE.bundle(fixed=(0,))
        shake(bundle)
        bundle.points *= factor
        bundle.translations *= factor
        cost = bundle.adjust(1.0, 15)
        results.append((cost, bundle.rotations, bundle.translations / factor))
    (cost, R, t), (scaled_cost, scaled_R, scaled_t) = results
    assert scaled_cost == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(scaled_R, R, atol=1e-5)
    np.testing.assert_allclose(scaled_t, t, atol=1e-3)


def test_points_that_say_nothing_break_nothing() -> None:
    """All cameras in one place: no depth, parallel rays; and one camera sees no point at all."""
    drive = replace(DRIVE, step_m=0.0, turn_deg=5)
    bundle, _ = drive.bundle(fixed=(0,))
    bundle.select(bundle.cameras != 3, 2)
    before = bundle.translations[3].copy()
    assert np.isfinite(bundle.adjust(1.0, 20))
    assert np.isfinite(bundle.points).all()
    np.testing.assert_allclose(bundle.translations[3], before)
    bundle.select(np.zeros(len(bundle.cameras), bool), 2)
    assert bundle.adjust(1.0, 5) == 0.0


def test_a_point_without_a_depth_is_left_out_of_the_equations() -> None:
    """Exactly singular: all its rays are parallel, to the last bit."""
    V, b = np.full((1, 3, 3), 1e8), np.ones((1, 3))
    S, s, V_inv = np.eye(6), np.ones(6), np.ones((1, 3, 3))
    starts, cameras = np.array([0, 1]), np.array([0])
    eliminate_points(cameras, starts, np.ones((1, 6, 3)), V, b, 0.0, S, s, V_inv)
    np.testing.assert_array_equal(S, np.eye(6))
    np.testing.assert_array_equal(s, np.ones(6))


def project(R: Array, t: Array, point: Array, lens: Array) -> Array:
    """The slow, obvious version."""
    x, y, z = R @ point + t
    slope = np.array([x, y]) / z
    r2 = slope @ slope
    radial = slope * (1 + lens[4] * r2 + lens[5] * r2**2)
    swapped = 2 * slope.prod() * lens[6:]
    tangential = swapped + lens[[7, 6]] * (r2 + 2 * slope**2)
    return np.asarray(lens[:2] * (radial + tangential) + lens[2:4])


def derivative(function: object, num: int, step: float = 1e-6) -> Array:
    """Return (2, num) by central differences around zero."""
    assert callable(function)
    steps = step * np.eye(num)
    return np.stack([(function(d) - function(-d)) / (2 * step) for d in steps], axis=1)


def numeric_jacobians(R: Array, t: Array, X: Array, lens: Array) -> tuple[Array, Array, Array]:
    """By pose (rotation, translation), point, and the seven shared unknowns."""

    def calibrated(d: Array) -> Array:
        centre = lens[2:4] + lens[:2] * d[1:3]
        return np.concatenate([lens[:2] * (1 + d[0]), centre, lens[4:] + d[3:]])

    return (
        derivative(lambda d: project(rotation_exp(d[:3]) @ R, t + d[3:], X, lens), 6),
        derivative(lambda d: project(R, t, X + d, lens), 3),
        derivative(lambda d: project(R, t, X, calibrated(d)), NUM_SHARED),
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("error_px", [0.5, 8.0])
def test_jacobians_are_those_of_numeric_differentiation(seed: int, error_px: float) -> None:
    """Inside the Huber threshold and outside, where rows shrink by the root of the weight."""
    rng, huber = np.random.default_rng(seed), 2.0
    R, t = rotation_exp(rng.normal(0, 0.5, 3)), rng.normal(0, 1, 3)
    X = R.T @ (np.array([*rng.uniform(-3, 3, 2), 6.0]) - t)
    offset = rng.normal(size=2)
    pixel = project(R, t, X, LENS) - error_px * offset / np.linalg.norm(offset)
    J_cam, J_point, J = np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, NUM_SHARED))
    r = np.zeros(2)
    linearise(R, t, X, pixel, LENS, huber, J_cam, J_point, r)
    x, y, z = R @ X + t
    shared_jacobian(x / z, y / z, LENS, pixel, huber, J)
    weight = 1.0 if error_px < huber else np.sqrt(huber / error_px)
    np.testing.assert_allclose(r, weight * (project(R, t, X, LENS) - pixel), atol=1e-9)
    for ours, numeric in zip((J_cam, J_point, J), numeric_jacobians(R, t, X, LENS), strict=True):
        np.testing.assert_allclose(ours, weight * numeric, rtol=1e-6, atol=1e-4)


def test_equations_without_points_are_those_of_dense_elimination() -> None:
    """The slow version writes down the whole Jacobian and eliminates the points by solving."""
    drive = Drive(num_frames=4, num_points=60, turn_deg=10)
    bundle, _ = drive.bundle()
    bundle.intrinsics = LENS
    num_cams, num = 4, len(bundle.points)
    J = np.zeros((2 * len(bundle.cameras), 6 * num_cams + NUM_SHARED + 3 * num))
    r = np.zeros(2 * len(bundle.cameras))
    for o, (c, p) in enumerate(zip(bundle.cameras, bundle.point_of, strict=True)):
        R, t, X = bundle.rotations[c], bundle.translations[c], bundle.points[p]
        rows, start = slice(2 * o, 2 * o + 2), 6 * num_cams + NUM_SHARED + 3 * p
        by_pose, by_point, by_lens = numeric_jacobians(R, t, X, LENS)
        J[rows, 6 * c : 6 * c + 6], J[rows, start : start + 3] = by_pose, by_point
        J[rows, 6 * num_cams : 6 * num_cams + NUM_SHARED] = by_lens
        r[rows] = project(R, t, X, LENS) - bundle.pixels[o]
    shared_end = 6 * num_cams + NUM_SHARED
    A, B = J[:, :shared_end], J[:, shared_end:]
    rest = A - B @ np.linalg.solve(B.T @ B, B.T @ A)
    H, g = A.T @ rest, -rest.T @ r
    poses = bundle.rotations, bundle.translations
    tracks = bundle.points, bundle.cameras, bundle.starts, bundle.pixels
    S, cross, shared, s, shared_g = shared_equations(*poses, *tracks, LENS, NO_LOSS)
    cams, scale = slice(6 * num_cams), np.sqrt(np.diag(H))
    ours = np.block([[np.tril(S), np.zeros_like(cross)], [cross.T, shared]])
    blocks = np.kron(np.tril(np.ones((num_cams, num_cams))), np.ones((6, 6)))
    np.testing.assert_allclose(
        (S * blocks / scale[cams] / scale[cams, None]),
        H[cams, cams] * blocks / scale[cams] / scale[cams, None],
        atol=1e-5,
    )
    np.testing.assert_allclose(ours[6 * num_cams :] / scale, H[6 * num_cams :] / scale, rtol=1e-4)
    np.testing.assert_allclose(
        np.concatenate([s, shared_g]) / scale, g / scale, rtol=1e-3, atol=1e-2
    )
