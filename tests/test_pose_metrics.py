"""Camera poses are scored as the paper's tables do, and a mean names what it lacks."""

import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_evaluation import drifting, evo_pair, trajectory, winding_drive

from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.evaluation import (
    KITTI_ODOMETRY,
    PointErrors,
    SequenceScores,
    VideoDepthProtocol,
    evaluate_trajectory,
    evaluate_video_depth,
    failed_sequence,
    kitti_means,
    kitti_scores,
    mean_score,
    point_scores,
    pose_scores,
    video_depth_scores,
)
from laser_slam.types import Trajectory

Array = NDArray[np.float64]
DATA = os.environ.get("LASER_SLAM_DATA")
needs_data = pytest.mark.skipif(
    DATA is None, reason="LASER_SLAM_DATA does not name the data folder"
)

# Table "Large-scale Camera Pose Estimation on KITTI" of the LASER paper: Avg., Avg.*, 00 to 10.
PUBLISHED = {
    "LASER (pi3)": (
        (24.17, 14.42),
        (6.14, 121.61, 59.87, 2.64, 1.36, 2.73, 2.92, 2.28, 33.14, 17.95, 15.20),
    ),
    "pi3-Long": (
        (30.72, 16.45),
        (6.28, 173.45, 63.92, 4.96, 1.66, 6.11, 4.89, 3.99, 36.08, 14.78, 21.84),
    ),
    "VGGT-Long": (
        (27.64, 18.28),
        (8.67, 121.17, 32.08, 6.12, 4.23, 8.31, 5.34, 4.63, 53.10, 41.99, 18.37),
    ),
    "ORB-SLAM2 with loops": (
        (54.82, 9.46),
        (6.03, 508.34, 14.76, 1.02, 1.57, 4.04, 11.16, 2.19, 38.85, 8.39, 6.63),
    ),
}


def evo_scores(estimate: Trajectory, truth: Trajectory) -> tuple[float, float, float]:
    """Return ATE, RPE trans and RPE rot as the evaluation of MonST3R and CUT3R asks evo for."""
    metrics = pytest.importorskip("evo.core.metrics")
    units = metrics.Unit.frames
    true, found = evo_pair(estimate, truth)
    found.align(true, correct_scale=True)
    relation = metrics.PoseRelation
    asked = (
        metrics.APE(relation.translation_part),
        metrics.RPE(relation.translation_part, 1, units, 0.01, all_pairs=True),
        metrics.RPE(relation.rotation_angle_deg, 1, units, 0.01, all_pairs=True),
    )
    for metric in asked:
        metric.process_data((true, found))
    ate, moves, turns = (metric.get_statistic(metrics.StatisticsType.rmse) for metric in asked)
    return ate, moves, turns


def assert_agrees_with_evo(true: Array, seed: int) -> None:
    truth = trajectory(true)
    estimate = trajectory(drifting(true, np.random.default_rng(seed), scale=0.05))
    mine = pose_scores("room", evaluate_trajectory(estimate, truth)).scores
    theirs = evo_scores(estimate, truth)
    assert list(mine) == ["ate_m", "rpe_trans_m", "rpe_rot_deg"]
    assert tuple(mine.values()) == pytest.approx(theirs, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_random_paths_are_scored_as_evo_does(seed: int) -> None:
    assert_agrees_with_evo(winding_drive(90, seed=seed), seed)


@needs_data
def test_a_real_room_is_scored_as_evo_does() -> None:
    truth = SevenScenes(Path(str(DATA)) / "7scenes/kitchen/seq-01").info.truth
    assert truth is not None
    assert_agrees_with_evo(truth.world_from_cam, 0)


@needs_data
@pytest.mark.parametrize("sequence", ["03", "06"])
def test_real_drives_are_scored_as_evo_does(sequence: str) -> None:
    lines = np.loadtxt(Path(str(DATA)) / "kitti_odometry/poses" / f"{sequence}.txt")
    true = np.tile(np.eye(4), (len(lines), 1, 1))
    true[:, :3] = lines.reshape(-1, 3, 4)
    assert_agrees_with_evo(true, 0)


def test_a_perfect_estimate_scores_zero_in_any_unit() -> None:
    true = winding_drive(300)
    for unit in (0.01, 100.0):
        moved = true.copy()
        moved[:, :3, 3] *= unit
        errors = evaluate_trajectory(trajectory(moved), trajectory(true))
        for row in (pose_scores("a", errors), kitti_scores("a", errors)):
            assert row.coverage == 1
            assert max(value or 0 for value in row.scores.values()) < 1e-5
            assert None not in row.scores.values()


def test_a_sequence_that_was_lost_halfway_says_so() -> None:
    true = winding_drive(100)
    errors = evaluate_trajectory(trajectory(true[:40]), trajectory(true))
    assert (errors.num_frames, errors.num_truth) == (40, 100)
    assert pose_scores("a", errors).coverage == pytest.approx(0.4)


def test_a_sequence_that_cannot_be_scored_is_a_row_with_its_reason() -> None:
    still = np.tile(np.eye(4), (9, 1, 1))
    errors = evaluate_trajectory(trajectory(still), trajectory(winding_drive(9)))
    for row in (pose_scores("a", errors), kitti_scores("a", errors)):
        assert row.reason is not None
        assert "stays in one place" in row.reason
        assert set(row.scores.values()) == {None}
    assert kitti_scores("a", evaluate_trajectory(*2 * [trajectory(still[:0])])).coverage is None


@pytest.mark.parametrize("system", PUBLISHED)
def test_the_papers_averages_follow_from_its_sequences(system: str) -> None:
    averages, ates = PUBLISHED[system]
    rows = [
        SequenceScores(name, {"ate_m": ate}) for name, ate in zip(KITTI_ODOMETRY, ates, strict=True)
    ]
    every, star = kitti_means(rows)
    assert (every.value, star.value) == pytest.approx(averages, abs=0.0101)
    assert (every.num, star.num) == (11, 10)
    assert not every.missing


def test_a_failed_sequence_counts_for_no_mean_and_is_named() -> None:
    rows = [SequenceScores("00", {"ate_m": 6.0}), failed_sequence("01", "tracking lost")]
    every, star = kitti_means(rows)
    assert (every.value, every.num, every.num_sequences) == (6.0, 1, 11)
    assert every.missing == KITTI_ODOMETRY[1:]
    assert star.missing == KITTI_ODOMETRY[2:]
    assert rows[1].reason == "tracking lost"


def test_a_mean_of_nothing_is_none() -> None:
    for rows in ([], [failed_sequence("a", "no images")], [SequenceScores("a", {"ate_m": None})]):
        mean = mean_score(rows, "ate_m")
        assert (mean.value, mean.num) == (None, 0)
        assert mean.num_sequences == len(rows)


def test_the_order_of_rows_does_not_matter() -> None:
    rows = [SequenceScores(str(i), {"ate_m": float(i**2)}, weight=i + 1.0) for i in range(7)]
    for is_weighted in (False, True):
        there = mean_score(rows, "ate_m", is_weighted=is_weighted)
        back = mean_score(rows[::-1], "ate_m", is_weighted=is_weighted)
        assert there.value == pytest.approx(back.value)


def test_a_weighted_mean_of_videos_is_that_of_all_their_pixels() -> None:
    rng = np.random.default_rng(0)
    videos = []
    for size in ((5, 7), (20, 30)):
        truth = rng.uniform(1, 50, size).astype(np.float32)
        videos.append((truth * rng.uniform(0.6, 1.5, size).astype(np.float32), truth))
    protocol = VideoDepthProtocol()
    rows = [
        video_depth_scores(str(i), evaluate_video_depth(partial(list, [pair]), protocol, "metric"))
        for i, pair in enumerate(videos)
    ]
    pooled = evaluate_video_depth(lambda: videos, protocol, "metric")
    for name, value in (("abs_rel", pooled.abs_rel), ("delta_125", pooled.delta_125)):
        weighted = mean_score(rows, name, is_weighted=True)
        assert weighted.value == pytest.approx(value, abs=1e-12)
        assert mean_score(rows, name).value != pytest.approx(value, abs=1e-3)


def test_a_video_without_depth_has_no_weight_and_is_named() -> None:
    truth = np.ones((4, 4), dtype=np.float32)
    good = evaluate_video_depth(lambda: [(truth, truth)], VideoDepthProtocol())
    blind = evaluate_video_depth(lambda: [(None, truth)], VideoDepthProtocol())
    rows = [video_depth_scores("good", good), video_depth_scores("blind", blind)]
    mean = mean_score(rows, "abs_rel", is_weighted=True)
    assert mean.value == pytest.approx(0, abs=1e-9)
    assert mean.missing == ("blind",)
    assert rows[1].reason == "no pixel has both depth and truth"


def test_rows_of_point_maps_keep_all_columns_and_the_share_of_points() -> None:
    row = point_scores("a", PointErrors(acc_mean_m=0.1, num_points=3, num_truth=4))
    assert row.scores["acc_mean_m"] == 0.1
    assert row.scores["nc_median"] is None
    assert row.coverage == 0.75
    assert point_scores("b", PointErrors(reason="no points")).coverage is None
