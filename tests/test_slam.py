"""The chain of windows: a pose for every keyframe, one owner each, whatever a window lacks."""

import logging

import numpy as np
import pytest
from corridor import SIZE, STEP_M, true_pose, true_prediction

from laser_slam.config import Config
from laser_slam.sim3 import umeyama
from laser_slam.slam import Slam
from laser_slam.types import Trajectory, WindowStatus

SIZE_OF_WINDOW, OVERLAP, NUM_WINDOWS = 8, 3, 5
NUM_FRAMES = NUM_WINDOWS * (SIZE_OF_WINDOW - OVERLAP) + OVERLAP
TIMES_S = np.arange(NUM_FRAMES) / 10.0


def run_slam(statuses: dict[int, WindowStatus] | None = None, *, step: int = 1) -> Slam:
    """Place five windows, each in a unit of its own."""
    slam = Slam(Config())
    units = np.random.default_rng(1).uniform(0.2, 5.0, NUM_WINDOWS)
    for window in range(NUM_WINDOWS):
        start = window * (SIZE_OF_WINDOW - OVERLAP)
        frames = np.arange(start, start + SIZE_OF_WINDOW) * step
        status = (statuses or {}).get(window, WindowStatus.OK)
        prediction = true_prediction(frames, float(units[window]), status)
        slam.add(prediction, np.zeros((SIZE_OF_WINDOW, *SIZE, 3), np.uint8))
    return slam


def centres(trajectory: Trajectory) -> np.ndarray:
    return trajectory.world_from_cam[:, :3, 3]


def error_m(trajectory: Trajectory) -> float:
    """Return the largest distance to the truth after a Sim(3) alignment."""
    truth = np.stack([true_pose(int(frame))[:3, 3] for frame in trajectory.frames])
    return float(
        np.abs(umeyama(centres(trajectory), truth).apply(centres(trajectory)) - truth).max()
    )


def test_windows_in_units_of_their_own_chain_to_the_true_path() -> None:
    trajectory = run_slam().trajectory(TIMES_S)
    assert error_m(trajectory) < 1e-3 * STEP_M * NUM_FRAMES


def test_the_world_is_the_first_camera() -> None:
    trajectory = run_slam().trajectory(TIMES_S)
    assert np.allclose(trajectory.world_from_cam[0], np.eye(4), atol=1e-12)


def test_every_frame_has_exactly_one_owner_in_the_middle_of_the_overlap() -> None:
    slam = run_slam()
    owners = np.zeros(NUM_FRAMES, int)
    for node in slam.nodes:
        owners[node.frames[node.is_owned]] += 1
    assert (owners == 1).all()
    second = slam.nodes[1]
    assert second.is_owned.tolist() == [False] + 5 * [True] + 2 * [False]


def test_a_last_window_that_repeats_most_of_the_one_before_owns_its_end_only() -> None:
    slam = Slam(Config())
    for start in (0, 5, 7):
        frames = np.arange(start, start + 8)
        slam.add(true_prediction(frames), np.zeros((8, *SIZE, 3), np.uint8))
    owned = [node.frames[node.is_owned] for node in slam.nodes]
    assert np.array_equal(np.concatenate(owned), np.arange(15))
    assert all(len(frames) for frames in owned)


@pytest.mark.parametrize(
    "status", [WindowStatus.STATIC, WindowStatus.ROTATION, WindowStatus.FAILED]
)
def test_a_window_without_depth_is_bridged_with_one_warning(
    status: WindowStatus, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        slam = run_slam({2: status})
    assert list(slam.bridged) == [2, 3]
    assert len(caplog.records) == 2
    assert "window 2 is bridged" in caplog.text
    assert np.isfinite(slam.trajectory(TIMES_S).world_from_cam).all()


def test_a_failed_window_continues_at_the_speed_before_it_without_a_jump() -> None:
    slam = run_slam({2: WindowStatus.FAILED})
    path = centres(slam.trajectory(TIMES_S))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    failed = slam.nodes[2].frames[slam.nodes[2].is_owned]
    inside = steps[failed[0] : failed[-1]]
    before = steps[failed[0] - 4 : failed[0] - 1]
    assert np.allclose(inside, before.mean(), rtol=0.05)
    assert steps.max() < 1.5 * np.median(steps)


def test_a_failed_window_counts_the_frames_that_were_no_keyframes() -> None:
    """Keyframes come every third frame before the failure; then a gap of six."""
    slam = Slam(Config())
    slam.add(true_prediction(np.arange(0, 24, 3)), np.zeros((8, *SIZE, 3), np.uint8))
    frames = np.array([18, 21, 27, 30])
    failed = true_prediction(frames, status=WindowStatus.FAILED)
    slam.add(failed, np.zeros((4, *SIZE, 3), np.uint8))
    path = centres(slam.trajectory(np.arange(40.0)))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert np.isclose(steps[-2], 2 * steps[-1], rtol=0.02)


def test_failed_windows_from_the_start_stand_still() -> None:
    statuses = dict.fromkeys(range(NUM_WINDOWS), WindowStatus.FAILED)
    trajectory = run_slam(statuses).trajectory(TIMES_S)
    assert np.allclose(trajectory.world_from_cam, np.eye(4))


def test_the_submap_of_a_failed_window_has_the_poses_of_its_node() -> None:
    slam = run_slam({4: WindowStatus.FAILED})
    frames = slam.nodes[4].frames
    failed = true_prediction(frames, status=WindowStatus.FAILED)
    submap = slam.nodes[4].submap(failed, np.zeros((len(frames), *SIZE, 3), np.uint8))
    assert np.array_equal(submap.prediction.window_from_cam, slam.nodes[4].window_from_cam)
    assert submap.prediction.window_from_cam[-1, 2, 3] > submap.prediction.window_from_cam[0, 2, 3]


def test_windows_that_see_too_little_in_common_are_bridged() -> None:
    slam = Slam(Config())
    blind = true_prediction(np.arange(5, 13))
    blind.depth[:3], blind.confidence[:3] = np.nan, 0
    slam.add(true_prediction(np.arange(8)), np.zeros((8, *SIZE, 3), np.uint8))
    slam.add(blind, np.zeros((8, *SIZE, 3), np.uint8))
    assert list(slam.bridged) == [1]
    assert error_m(slam.trajectory(TIMES_S)) < 0.05
