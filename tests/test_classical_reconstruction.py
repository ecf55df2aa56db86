"""Windows from tracks: true poses, kept scale, and a plain no where nothing can be known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from rendered import RenderedDrive
from tracks import Drive, camera_centres, true_camera

from laser_slam.backbones.classical.reconstruction import MIN_SEEN, Reconstruction, Solver
from laser_slam.backbones.classical.tracking import FrameTracks, Tracker
from laser_slam.backbones.classical.twoview import (
    absolute_pose,
    choose_pair,
    fit_rotation,
    measure_motion,
    relative_pose,
)
from laser_slam.config import ClassicalConfig
from laser_slam.sim3 import Array, rotation_exp, umeyama

DRIVE = Drive(num_frames=12, turn_deg=15)


def solve(views: list[FrameTracks], K: Array, refine_radius: int = 0) -> Reconstruction | None:
    solver = Solver(views, K)
    if not solver.start_from_pair():
        return None
    solver.grow()
    return solver.finish(refine_radius)


def solved(drive: Drive) -> Reconstruction:
    solution = solve(drive.views, drive.intrinsics)
    assert solution is not None
    return solution


def relative_error(solution: Reconstruction, centres: Array) -> float:
    """Return the ATE after a similarity, as a share of the path."""
    ours = camera_centres(solution.rotations, solution.translations)[solution.has_pose]
    true = centres[solution.has_pose]
    gap = umeyama(ours, true).apply(ours) - true
    path = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(np.sqrt((gap**2).sum(axis=1).mean()) / path)


def lessen(view: FrameTracks, keep: NDArray[np.bool_]) -> FrameTracks:
    return replace(view, ids=view.ids[keep], pixels=view.pixels[keep])


@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.3])
def test_windows_come_out_true_in_spite_of_outliers(outliers: float) -> None:
    drive = replace(DRIVE, outliers=outliers)
    solution = solved(drive)
    assert solution.has_pose.all()
    assert relative_error(solution, drive.centres) < 0.002
    turned = solution.rotations[-1] @ solution.rotations[0].T
    np.testing.assert_allclose(turned, drive.rotations[-1] @ drive.rotations[0].T, atol=2e-3)


def test_points_carry_the_numbers_of_their_tracks() -> None:
    solution = solved(DRIVE)
    ours = camera_centres(solution.rotations, solution.translations)
    world_from_window = umeyama(ours, DRIVE.centres)
    points, true = solution.bundle.points, DRIVE.points[solution.ids]
    error = np.linalg.norm(world_from_window.apply(points) - true, axis=1)
    assert len(points) > 300
    assert np.median(error / np.linalg.norm(true - DRIVE.centres[5], axis=1)) < 0.02


def test_the_rendered_drive_comes_out_within_a_two_hundredth_of_the_path(
    short_drive: RenderedDrive,
) -> None:
    tracker = Tracker(ClassicalConfig(), memory=len(short_drive.images))
    for frame, grey in enumerate(short_drive.greys):
        tracker.add(frame, grey)
    solution = solve(tracker.history, short_drive.intrinsics, ClassicalConfig().refine_radius)
    assert solution is not None
    assert solution.has_pose.all()
    assert relative_error(solution, short_drive.centres) < 0.005


@pytest.mark.parametrize("num_frames", [3, 4, 5])
def test_three_frames_are_enough_when_they_move(num_frames: int) -> None:
    drive = replace(DRIVE, num_frames=num_frames, turn_deg=3)
    assert solved(drive).has_pose.all()
    assert relative_error(solved(drive), drive.centres) < 0.01


@pytest.mark.parametrize("num_frames", [1, 2])
def test_fewer_frames_give_nothing(num_frames: int) -> None:
    drive = replace(DRIVE, num_frames=num_frames, turn_deg=3)
    assert solve(drive.views, drive.intrinsics) is None
    assert Solver(drive.views, drive.intrinsics).finish() is None


@pytest.mark.parametrize("turn_deg", [0, 25])
@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_standstill_and_pure_rotation_have_no_pair(turn_deg: float, noise_px: float) -> None:
    drive = replace(DRIVE, step_m=0.0, turn_deg=turn_deg, noise_px=noise_px)
    assert choose_pair(drive.views, drive.intrinsics) is None
    assert not Solver(drive.views, drive.intrinsics).start_from_pair()


def test_a_stop_within_a_window_does_no_harm() -> None:
    views = DRIVE.views
    views = [*views[:6], *[replace(views[5], frame=6 + k) for k in range(4)], *views[6:]]
    solution = solve(views, DRIVE.intrinsics)
    assert solution is not None
    stops = [*range(6), 5, 5, 5, 5, *range(6, 12)]
    assert relative_error(solution, DRIVE.centres[stops]) < 0.003


def test_views_without_tracks_say_so() -> None:
    blank = [lessen(view, np.zeros(len(view.ids), bool)) for view in DRIVE.views]
    solver = Solver(blank, DRIVE.intrinsics)
    assert not solver.start_from_pair()
    solver.grow()
    assert solver.finish(5) is None


def test_tracks_of_nothing_rigid_give_nothing() -> None:
    rng = np.random.default_rng(0)
    views = [
        replace(view, pixels=rng.uniform([0, 0], [1239, 375], view.pixels.shape))
        for view in DRIVE.views
    ]
    assert solve(views, DRIVE.intrinsics) is None
    shared = np.intersect1d(views[0].ids, views[11].ids)[:32]
    few = [lessen(view, np.isin(view.ids, shared)) for view in views]
    assert choose_pair(few, DRIVE.intrinsics) is not None
    assert not Solver(few, DRIVE.intrinsics).start_from_pair()


@pytest.mark.parametrize("scale", [0.05, 1.0, 30.0])
def test_a_start_from_known_poses_keeps_their_scale(scale: float) -> None:
    solver = Solver(DRIVE.views, DRIVE.intrinsics)
    solver.start_from_known(
        {i: (DRIVE.rotations[i], scale * DRIVE.translations[i]) for i in range(6)}
    )
    solver.grow()
    solution = solver.finish()
    assert solution is not None
    assert solution.has_pose.all()
    ours = camera_centres(solution.rotations, solution.translations)
    assert umeyama(DRIVE.centres, ours).scale == pytest.approx(scale, rel=0.01)


def test_tracks_that_all_end_in_the_middle_leave_the_side_that_is_known() -> None:
    views = [replace(v, ids=v.ids + 10_000 * (v.frame > 6)) for v in DRIVE.views]
    solution = solve(views, DRIVE.intrinsics)
    assert solution is not None
    assert solution.has_pose.sum() in (5, 7)
    assert solution.has_pose[:7].all() != solution.has_pose[7:].all()
    assert solution.has_pose[solution.bundle.cameras].all()
    assert solution.bundle.is_fixed[~solution.has_pose].all()
    assert relative_error(solution, DRIVE.centres) < 0.005


def test_a_view_that_keeps_too_few_points_loses_its_pose() -> None:
    """Enough of its tracks are near for a first pose; nearly all err too much for the last."""
    views, rng = list(DRIVE.views), np.random.default_rng(1)
    shared = np.intersect1d(views[3].ids, views[6].ids)
    few = rng.choice(np.intersect1d(shared, views[9].ids), 28, replace=False)
    views[9] = lessen(views[9], np.isin(views[9].ids, few))
    error = rng.normal(0, 2.5, views[9].pixels.shape)
    views[9] = replace(views[9], pixels=views[9].pixels + error)
    solution = solve(views, DRIVE.intrinsics)
    assert solution is not None
    seen = np.bincount(solution.bundle.cameras, minlength=12)
    assert (seen[solution.has_pose] >= MIN_SEEN).all()
    assert not solution.has_pose[9]
    assert seen[9] == 0
    assert solution.has_pose.sum() == 11


@pytest.mark.parametrize("width", [320, 2560])
def test_thresholds_scale_with_the_image(width: int) -> None:
    """The same drive seen with fewer or more pixels, noise and outliers in proportion."""
    drive, factor = replace(DRIVE, noise_px=1.0, outliers=0.2), width / 1240
    size = (round(376 * factor), width)
    views = [
        replace(v, pixels=(v.pixels + 0.5) * factor - 0.5, grey=np.zeros(size, np.uint8))
        for v in drive.views
    ]
    K = true_camera().copy()
    K[:2] *= factor
    K[:2, 2] += 0.5 * factor - 0.5
    solution = solve(views, K)
    assert solution is not None
    assert solution.has_pose.all()
    assert relative_error(solution, drive.centres) < 0.004
    expected = len(solved(drive).bundle.cameras)
    assert len(solution.bundle.cameras) == pytest.approx(expected, rel=0.03)


def test_poselib_has_our_pixel_centres() -> None:
    drive = replace(DRIVE, noise_px=0.0)
    pixels, z = drive.true_pixels(4)
    ahead = z > 3
    R, t, inliers = absolute_pose(pixels[ahead], drive.points[ahead], drive.intrinsics, 2.0)
    assert inliers == ahead.sum()
    np.testing.assert_allclose(R, drive.rotations[4], atol=1e-9)
    np.testing.assert_allclose(t, drive.translations[4], atol=1e-7)
    R, t, _ = relative_pose(drive.views[0], drive.views[6], drive.intrinsics, 1.0)
    np.testing.assert_allclose(R, drive.rotations[6], atol=1e-6)
    true = drive.translations[6] / np.linalg.norm(drive.translations[6])
    np.testing.assert_allclose(t, true, atol=1e-6)


def test_no_pose_has_no_inliers() -> None:
    """All points in one place: every sample fails, and what poselib returns is not a number."""
    pixels = np.random.default_rng(0).uniform(0, 300, (50, 2))
    assert absolute_pose(pixels, np.zeros((50, 3)), DRIVE.intrinsics, 1.0)[2] == 0


def test_motion_is_split_into_rotation_and_parallax() -> None:
    still = replace(DRIVE, step_m=0.0, turn_deg=10, noise_px=0.1)
    motion = measure_motion(still.views[0], still.views[11], still.intrinsics)
    assert motion.flow_px > 100
    assert motion.parallax_px < 0.5
    np.testing.assert_allclose(motion.second_from_first, still.rotations[11], atol=1e-4)
    moved = measure_motion(DRIVE.views[0], DRIVE.views[3], DRIVE.intrinsics)
    assert moved.parallax_px > 3


def test_a_rotation_survives_a_third_of_outliers() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(600, 3))
    source /= np.linalg.norm(source, axis=1, keepdims=True)
    true = rotation_exp(np.array([0.1, -0.2, 0.05]))
    target = source @ true.T
    target[:200] = rotation_exp(np.array([0.0, 0.3, 0.0])) @ true @ source[0]
    np.testing.assert_allclose(fit_rotation(source, target, 20), true, atol=0.01)
