"""Camera poses are scored as evo does on the paper's terms, and a mean names what it lacks."""

import os
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_evaluation import drifting, evo_pair, trajectory, winding_drive

from laser_slam.benchmarks import Cell, Outcome, fill_grids
from laser_slam.benchmarks.table import parse_table
from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.evaluation import (
    Statistics,
    TrajectoryErrors,
    VideoDepthErrors,
    VideoDepthProtocol,
    align,
    evaluate_trajectory,
    evaluate_video_depth,
    relative_errors,
)
from laser_slam.types import Trajectory

Array = NDArray[np.float64]
DATA = os.environ.get("LASER_SLAM_DATA")
needs_data = pytest.mark.skipif(
    DATA is None, reason="LASER_SLAM_DATA does not name the data folder"
)


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


def paper_scores(errors: TrajectoryErrors) -> tuple[float | None, ...]:
    """Return ATE, RPE trans and RPE rot, which a camera-pose table of the paper shows."""
    parts = (errors.ate_sim3_m, errors.rpe_translation_m, errors.rpe_rotation_deg)
    return tuple(part.rmse if isinstance(part, Statistics) else None for part in parts)


def assert_agrees_with_evo(true: Array, seed: int) -> None:
    truth = trajectory(true)
    estimate = trajectory(drifting(true, np.random.default_rng(seed), scale=0.05))
    assert paper_scores(evaluate_trajectory(estimate, truth)) == pytest.approx(
        evo_scores(estimate, truth), abs=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_random_paths_are_scored_as_evo_does(seed: int) -> None:
    assert_agrees_with_evo(winding_drive(90, seed=seed), seed)


@needs_data
def test_a_real_room_is_scored_as_evo_does() -> None:
    truth = SevenScenes(Path(str(DATA)) / "7scenes/kitchen/seq-01").info.truth
    assert truth is not None
    assert_agrees_with_evo(truth.world_from_cam, 0)


@needs_data
@pytest.mark.parametrize("sequence", ["03", "04", "07"])
def test_real_drives_are_scored_as_evo_does(sequence: str) -> None:
    lines = np.loadtxt(Path(str(DATA)) / "kitti_gt_poses" / f"{sequence}.txt")
    true = np.tile(np.eye(4), (len(lines), 1, 1))
    true[:, :3] = lines.reshape(-1, 3, 4)
    assert_agrees_with_evo(true, 0)


@pytest.mark.parametrize("seed", range(3))
def test_paths_with_gaps_are_scored_as_evo_does_what_is_there(seed: int) -> None:
    """A third of the truth is missing, and the estimate loses a stretch.

    evo takes what both have. Its relative errors are from each frame to the next that is there;
    those that are over one frame are the same here, and the others are not asked.
    """
    metrics = pytest.importorskip("evo.core.metrics")
    rng = np.random.default_rng(seed)
    true = winding_drive(200, seed=seed)
    moved = drifting(true, rng, scale=0.05)
    posed = np.flatnonzero(rng.random(200) > 0.33)
    tracked = np.r_[0:80, 120:200]
    truth, estimate = trajectory(true[posed], posed), trajectory(moved[tracked], tracked)
    both = np.intersect1d(posed, tracked)
    reference, found = evo_pair(trajectory(moved[both]), trajectory(true[both]))
    found.align(reference, correct_scale=True)
    errors = evaluate_trajectory(estimate, truth)
    assert (errors.num_frames, errors.num_truth) == (len(both), len(posed))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, found))
    np.testing.assert_allclose(errors.errors_m, ape.error, atol=1e-6)
    scale = align(estimate, truth, with_scale=True).scale
    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    is_one_frame = np.diff(both) == 1
    assert 30 < is_one_frame.sum() < len(both) - 30
    for relation, mine in zip(relations, relative_errors(estimate, truth, scale), strict=True):
        rpe = metrics.RPE(relation, 1, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, found))
        np.testing.assert_allclose(mine, np.asarray(rpe.error)[is_one_frame], atol=1e-6)


def test_a_perfect_estimate_scores_zero_in_any_unit() -> None:
    true = winding_drive(300)
    for unit in (0.01, 100.0):
        moved = true.copy()
        moved[:, :3, 3] *= unit
        errors = evaluate_trajectory(trajectory(moved), trajectory(true))
        assert errors.num_frames == errors.num_truth == 300
        for score in (*paper_scores(errors), errors.kitti.t_rel_percent):
            assert score == pytest.approx(0, abs=1e-5)


def test_a_sequence_that_was_lost_halfway_says_so() -> None:
    true = winding_drive(100)
    errors = evaluate_trajectory(trajectory(true[:40]), trajectory(true))
    assert (errors.num_frames, errors.num_truth) == (40, 100)
    assert errors.numbers()["num_truth"] == 100


# --- means ---------------------------------------------------------------------------------------


def video_cells(*videos: VideoDepthErrors) -> tuple[Cell, ...]:
    """Return the means of Abs Rel and delta that a table makes of videos."""
    table = parse_table("""
        title: videos
        sequences: {a: {reader: synthetic}, b: {reader: synthetic}}
        groups: {all: [a, b]}
        blocks:
          - title: t
            columns:
              - {name: c, measure: bonn_abs_rel, over: all}
              - {name: d, measure: bonn_delta_percent, over: all}
        """)
    outcomes = [
        Outcome("ours", name, {"video_depth_bonn": asdict(errors)})
        for name, errors in zip(table.sequences, videos, strict=True)
    ]
    return fill_grids(table, outcomes)[0].rows[0].cells


def test_a_weighted_mean_of_videos_is_that_of_all_their_pixels() -> None:
    rng = np.random.default_rng(0)
    videos = []
    for size in ((5, 7), (20, 30)):
        truth = rng.uniform(1, 50, size).astype(np.float32)
        videos.append((truth * rng.uniform(0.6, 1.5, size).astype(np.float32), truth))
    protocol = VideoDepthProtocol()
    each = [evaluate_video_depth(partial(list, [pair]), protocol, "metric") for pair in videos]
    pooled = evaluate_video_depth(lambda: videos, protocol, "metric")
    assert pooled.abs_rel is not None
    assert pooled.delta_125 is not None
    abs_rel, delta = (cell.value for cell in video_cells(*each))
    assert abs_rel == pytest.approx(pooled.abs_rel, abs=1e-12)
    assert delta == pytest.approx(100 * pooled.delta_125, abs=1e-10)


def test_a_video_of_which_little_is_predicted_weighs_as_much_as_predicted_whole() -> None:
    """Whoever predicts only what is easy of a hard video does not make it count less."""
    truth = np.ones((10, 10), dtype=np.float32)
    little = np.full((10, 10), np.nan, np.float32)
    little[0] = 1.3
    protocol = VideoDepthProtocol()
    for hard in (np.full((10, 10), 1.3, np.float32), little):
        each = [
            evaluate_video_depth(partial(list, [(depth, truth)]), protocol, "metric")
            for depth in (truth, hard)
        ]
        abs_rel, _ = video_cells(*each)
        assert abs_rel.value == pytest.approx(0.15, abs=1e-6)
        assert abs_rel.num == 2


def test_a_video_without_depth_is_in_no_mean_and_is_named() -> None:
    truth = np.ones((4, 4), dtype=np.float32)
    good = evaluate_video_depth(lambda: [(truth, truth)], VideoDepthProtocol())
    blind = evaluate_video_depth(lambda: [(None, truth)], VideoDepthProtocol())
    abs_rel, _ = video_cells(good, blind)
    assert abs_rel.value == pytest.approx(0, abs=1e-9)
    assert (abs_rel.num, abs_rel.num_wanted) == (1, 2)
    assert abs_rel.reasons == {"b": "no pixel has both depth and truth"}
    nothing, _ = video_cells(blind, blind)
    assert (nothing.value, nothing.num, nothing.text) == (None, 0, "-")
