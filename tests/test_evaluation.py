"""The scores agree with evo and with KITTI's definition, and are None where nothing is known."""

import itertools
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation import (
    absolute_errors,
    align,
    evaluate_depth,
    evaluate_trajectory,
    kitti_errors,
    relative_errors,
)
from laser_slam.evaluation.trajectory import KITTI_LENGTHS_M
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Trajectory

Array = NDArray[np.float64]
DATA = os.environ.get("LASER_SLAM_DATA")


def trajectory(world_from_cam: Array, frames: NDArray[np.int64] | None = None) -> Trajectory:
    chosen = np.arange(len(world_from_cam)) if frames is None else frames
    return Trajectory(chosen, chosen / 10.0, world_from_cam)


def winding_drive(num: int, step: float = 1.0, seed: int = 0) -> Array:
    """Integrate a smooth random yaw and pitch at ``step`` metres a frame."""
    rng = np.random.default_rng(seed)
    rates = np.cumsum(rng.normal(size=(num, 3)) * [0.0005, 0.002, 0.0005], axis=0)
    poses = np.tile(np.eye(4), (num, 1, 1))
    for (last, pose), rate in zip(itertools.pairwise(poses), rates[1:], strict=True):
        pose[:3, :3] = last[:3, :3] @ rotation_exp(0.3 * np.tanh(rate))
        pose[:3, 3] = last[:3, 3] + last[:3, :3] @ [0.0, 0.0, step]
    return poses


def drifting(true: Array, rng: np.random.Generator, scale: float = 1.0) -> Array:
    """Add a little to every motion, so that errors pile up; then move and scale the whole."""
    motions = np.linalg.inv(true[:-1]) @ true[1:]
    motions[:, :3, :3] @= rotation_exp(1e-3 * rng.normal(size=(len(motions), 3)))
    motions[:, :3, 3] *= 1 + 0.02 * rng.normal(size=(len(motions), 1))
    poses = [np.eye(4)]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    elsewhere = Sim3(scale, rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    return elsewhere.apply_poses(np.array(poses))


def pair(seed: int = 0, num: int = 1200, scale: float = 0.3) -> tuple[Trajectory, Trajectory]:
    rng = np.random.default_rng(seed)
    true = winding_drive(num, seed=seed)
    return trajectory(drifting(true, rng, scale)), trajectory(true)


def test_align_finds_a_known_similarity() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        true = winding_drive(50, seed=seed)
        moved = Sim3(rng.uniform(0.1, 5), rotation_exp(rng.normal(size=3)), rng.normal(size=3))
        found = align(trajectory(moved.apply_poses(true)), trajectory(true), with_scale=True)
        np.testing.assert_allclose((found @ moved).matrix(), np.eye(4), atol=1e-8)
        rigid = Sim3(1.0, moved.rotation, moved.translation)
        found = align(trajectory(rigid.apply_poses(true)), trajectory(true), with_scale=False)
        np.testing.assert_allclose((found @ rigid).matrix(), np.eye(4), atol=1e-8)


def test_a_perfect_estimate_has_no_error_in_any_unit() -> None:
    true = winding_drive(1000)
    for unit in (0.01, 1.0, 100.0):
        estimate = Sim3(unit, rotation_exp(np.ones(3)), np.ones(3)).apply_poses(true)
        scores = evaluate_trajectory(trajectory(estimate), trajectory(true))
        assert scores.scale == pytest.approx(1 / unit)
        assert scores.ate_sim3_m is not None
        assert scores.ate_sim3_m.max < 1e-8
        assert scores.kitti.t_rel_percent == pytest.approx(0, abs=1e-8)
        assert scores.kitti.r_rel_deg_per_100m == pytest.approx(0, abs=1e-6)
        assert scores.drift_m.max() < 1e-7
        assert scores.path_length_m == pytest.approx(999)


def test_a_wrong_scale_shows_only_without_scale_alignment() -> None:
    true = np.tile(np.eye(4), (1000, 1, 1))
    true[:, 2, 3] = np.arange(1000)
    scores = evaluate_trajectory(trajectory(Sim3(1.1).apply_poses(true)), trajectory(true))
    assert scores.kitti.t_rel_percent == pytest.approx(0, abs=1e-8)
    assert scores.kitti_unscaled.t_rel_percent is not None
    # 10 % of a segment, which is up to a frame longer than its nominal length
    assert 10 < scores.kitti_unscaled.t_rel_percent < 10.11
    assert scores.ate_se3_m is not None
    assert scores.ate_se3_m.rmse > 5


def test_the_unit_of_the_estimate_changes_no_aligned_score() -> None:
    estimate, truth = pair()
    plain = evaluate_trajectory(estimate, truth)
    for factor in (0.01, 100.0):
        poses = Sim3(factor).apply_poses(estimate.world_from_cam)
        other = evaluate_trajectory(trajectory(poses), truth)
        assert other.ate_sim3_m is not None
        assert plain.ate_sim3_m is not None
        assert other.ate_sim3_m.rmse == pytest.approx(plain.ate_sim3_m.rmse)
        assert other.kitti.t_rel_percent == pytest.approx(plain.kitti.t_rel_percent)
        np.testing.assert_allclose(other.drift_m, plain.drift_m, atol=1e-6)


def test_only_common_frames_are_compared() -> None:
    estimate, truth = pair(num=300)
    some = np.arange(40, 290, 3)
    part = trajectory(truth.world_from_cam[some], some)
    scores = evaluate_trajectory(estimate, part)
    both = evaluate_trajectory(trajectory(estimate.world_from_cam[some], some), part)
    assert scores.num_frames == len(some)
    np.testing.assert_array_equal(scores.frames, some)
    assert scores.numbers() == both.numbers()
    moves, _ = relative_errors(estimate, part, delta=3)
    assert len(moves) == len(some) - 1
    assert scores.rpe_translation_m is None  # no two frames of the truth are neighbours


def test_a_short_drive_has_no_kitti_score() -> None:
    estimate, truth = pair(num=90)
    scores = evaluate_trajectory(estimate, truth)
    assert scores.kitti.t_rel_percent is None
    assert scores.kitti.r_rel_deg_per_100m is None
    assert scores.kitti.num_segments == 0
    assert scores.reason is None
    assert scores.ate_sim3_m is not None


@pytest.mark.parametrize(
    ("estimate", "truth", "reason"),
    [
        (winding_drive(9), np.tile(np.eye(4), (9, 1, 1)), "the true path stays in one place"),
        (np.tile(np.eye(4), (9, 1, 1)), winding_drive(9), "the estimated path stays in one place"),
        (winding_drive(9), winding_drive(2), "have 2 frames in common, need 3"),
        (winding_drive(9), winding_drive(0), "have 0 frames in common, need 3"),
    ],
)
def test_what_cannot_be_scored_is_none_with_a_reason(
    estimate: Array, truth: Array, reason: str
) -> None:
    with pytest.raises(DegenerateGeometryError, match=reason):
        align(trajectory(estimate), trajectory(truth), with_scale=False)
    scores = evaluate_trajectory(trajectory(estimate), trajectory(truth))
    assert scores.reason is not None
    assert reason in scores.reason
    numbers = scores.numbers()
    for name in ("scale", "ate_sim3_m", "ate_se3_m", "rpe_translation_m", "rpe_rotation_deg"):
        assert numbers[name] is None
    assert len(scores.errors_m) == len(scores.drift_m) == 0
    assert "NaN" not in json.dumps(numbers)


def test_scores_are_plain_numbers_for_json() -> None:
    estimate, truth = pair(num=300)
    numbers = json.loads(json.dumps(evaluate_trajectory(estimate, truth).numbers()))
    assert set(numbers["ate_sim3_m"]) == {"rmse", "mean", "median", "max"}
    assert numbers["kitti"]["num_segments"] > 0


def test_drift_grows_from_zero() -> None:
    estimate, truth = pair()
    scores = evaluate_trajectory(estimate, truth)
    assert scores.drift_m[0] == pytest.approx(0, abs=1e-9)
    assert scores.drift_m[-200:].mean() > 5 * scores.drift_m[:200].mean()
    assert (np.diff(scores.distances_m) > 0).all()


# --- against evo ---------------------------------------------------------------------------------


def evo_pair(estimate: Trajectory, truth: Trajectory) -> tuple[Any, Any]:
    """Return (truth, estimate) as evo wants them."""
    path = pytest.importorskip("evo.core.trajectory").PosePath3D
    return tuple(path(poses_se3=list(part.world_from_cam)) for part in (truth, estimate))


@pytest.mark.parametrize("with_scale", [True, False])
def test_absolute_errors_agree_with_evo(with_scale: bool) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    for seed in range(3):
        estimate, truth = pair(seed, num=400)
        true, found = evo_pair(estimate, truth)
        found.align(true, correct_scale=with_scale)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((true, found))
        by = align(estimate, truth, with_scale=with_scale)
        np.testing.assert_allclose(absolute_errors(estimate, truth, by), ape.error, atol=1e-6)
        scores = evaluate_trajectory(estimate, truth)
        mine = scores.ate_sim3_m if with_scale else scores.ate_se3_m
        assert mine is not None
        theirs = ape.get_all_statistics()
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(mine, name) == pytest.approx(theirs[name], abs=1e-6)


@pytest.mark.parametrize("delta", [1, 10])
def test_relative_errors_agree_with_evo(delta: int) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    estimate, truth = pair(4, num=400)
    true, found = evo_pair(estimate, truth)
    scale = align(estimate, truth, with_scale=True).scale
    found.align(true, correct_scale=True)
    for relation, mine in zip(
        (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad),
        relative_errors(estimate, truth, scale, delta),
        strict=True,
    ):
        rpe = metrics.RPE(relation, delta, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((true, found))
        np.testing.assert_allclose(mine, rpe.error, atol=1e-6)


# --- against KITTI's definition, one segment at a time -------------------------------------------


def slow_kitti_errors(found: Array, true: Array) -> tuple[float, float, int]:
    """Follow the definition of the odometry benchmark literally, in plain Python."""
    distances = [0.0]
    for last, pose in itertools.pairwise(true):
        distances.append(distances[-1] + math.dist(last[:3, 3], pose[:3, 3]))
    moves, turns = [], []
    for first in range(0, len(true), 10):
        for length in KITTI_LENGTHS_M:
            last_frame = -1
            for frame in range(first, len(true)):
                if distances[frame] > distances[first] + length:
                    last_frame = frame
                    break
            if last_frame < 0:
                continue
            true_motion = np.linalg.inv(true[first]) @ true[last_frame]
            motion = np.linalg.inv(found[first]) @ found[last_frame]
            error = np.linalg.inv(motion) @ true_motion
            cosine = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1)
            turns.append(math.acos(max(min(cosine, 1.0), -1.0)) / length)
            moves.append(math.dist(error[:3, 3], (0, 0, 0)) / length)
    if not moves:
        return math.nan, math.nan, 0
    return (
        100 * sum(moves) / len(moves),
        100 * math.degrees(sum(turns) / len(turns)),
        len(moves),
    )


def test_kitti_errors_agree_with_the_slow_definition() -> None:
    for seed, num in ((0, 1200), (1, 333), (2, 105)):
        estimate, truth = pair(seed, num, scale=1.0)
        mine = kitti_errors(estimate, truth)
        t_rel, r_rel, count = slow_kitti_errors(estimate.world_from_cam, truth.world_from_cam)
        assert mine.num_segments == count
        assert mine.t_rel_percent == pytest.approx(t_rel, abs=1e-6)
        assert mine.r_rel_deg_per_100m == pytest.approx(r_rel, abs=1e-6)


def test_one_length_of_kitti_is_close_to_evos_error_per_distance() -> None:
    """evo picks the frame nearest to the length, KITTI the first beyond it: close, not equal."""
    metrics = pytest.importorskip("evo.core.metrics")
    estimate, truth = pair(3, 195, scale=1.0)
    true, found = evo_pair(estimate, truth)
    rpe = metrics.RPE(
        metrics.PoseRelation.translation_part, 100, metrics.Unit.meters, 0.02, True, True
    )
    rpe.process_data((true, found))
    mine = kitti_errors(estimate, truth)
    theirs = rpe.error[::10]
    assert mine.num_segments == len(theirs)
    assert mine.t_rel_percent == pytest.approx(theirs.mean(), rel=0.05)


@pytest.mark.skipif(DATA is None, reason="LASER_SLAM_DATA does not name the data folder")
@pytest.mark.parametrize("sequence", ["03", "04", "07"])
def test_real_drives_are_scored_as_kitti_does(sequence: str) -> None:
    lines = np.loadtxt(Path(str(DATA)) / "kitti_gt_poses" / f"{sequence}.txt")
    true = np.tile(np.eye(4), (len(lines), 1, 1))
    true[:, :3] = lines.reshape(-1, 3, 4)
    truth = trajectory(true)
    estimate = trajectory(drifting(true, np.random.default_rng(0), scale=0.05))
    scores = evaluate_trajectory(estimate, truth)
    assert scores.scale is not None
    scaled = Sim3(scores.scale).apply_poses(estimate.world_from_cam)
    t_rel, r_rel, count = slow_kitti_errors(scaled, true)
    assert scores.kitti.num_segments == count > 0
    assert scores.kitti.t_rel_percent == pytest.approx(t_rel, abs=1e-6)
    assert scores.kitti.r_rel_deg_per_100m == pytest.approx(r_rel, abs=1e-6)


# --- depth ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("alignment", ["median", "least_squares"])
def test_depth_in_another_unit_has_no_error(alignment: Any) -> None:
    truth = np.random.default_rng(0).uniform(2, 50, (3, 20, 30)).astype(np.float32)
    errors = evaluate_depth(0.1 * truth, truth, alignment=alignment)
    assert errors.abs_rel == pytest.approx(0, abs=1e-6)
    assert errors.rmse_log == pytest.approx(0, abs=1e-6)
    assert errors.delta_125 == 1
    assert errors.scale == pytest.approx(10, rel=1e-6)
    assert errors.coverage == 1


def test_depth_scores_follow_their_definitions() -> None:
    truth = np.array([[1.0, 2.0, 4.0, 10.0]], dtype=np.float32)
    depth = np.array([[1.1, 2.0, 6.0, 9.0]], dtype=np.float32)
    errors = evaluate_depth(depth, truth, alignment="none")
    assert errors.abs_rel == pytest.approx((0.1 + 0 + 0.5 + 0.1) / 4)
    assert errors.delta_125 == 0.75
    logs = np.log([1.1, 1.0, 1.5, 0.9])
    assert errors.rmse_log == pytest.approx(np.sqrt(np.mean(logs**2)))
    assert evaluate_depth(depth, truth).scale == pytest.approx(
        np.median([1 / 1.1, 1, 4 / 6, 10 / 9])
    )
    least = evaluate_depth(depth, truth, alignment="least_squares").scale
    assert least == pytest.approx((1.1 + 4 + 24 + 90) / (1.21 + 4 + 36 + 81))


def test_the_median_scale_survives_far_outliers() -> None:
    truth = np.random.default_rng(0).uniform(2, 50, (40, 50)).astype(np.float32)
    depth = np.where(truth > 38, 2 * truth, truth)
    robust = evaluate_depth(depth, truth).scale
    plain = evaluate_depth(depth, truth, alignment="least_squares").scale
    assert robust == pytest.approx(1)
    assert plain is not None
    assert plain < 0.7


def test_unknown_pixels_are_left_out_and_counted() -> None:
    truth = np.full((4, 5), 3.0, dtype=np.float32)
    truth[0] = np.nan
    depth = np.full((4, 5), 2.0, dtype=np.float32)
    depth[1, :2] = [np.nan, 0]
    depth[0] = 99
    mask = np.ones((4, 5), dtype=bool)
    mask[3] = False
    errors = evaluate_depth(depth, truth, mask)
    assert errors.num_pixels == 8
    assert errors.coverage == pytest.approx(8 / 15)
    assert errors.abs_rel == pytest.approx(0)


def test_nothing_to_compare_is_none_not_zero() -> None:
    some = np.ones((4, 5), dtype=np.float32)
    unknown = np.full((4, 5), np.nan, dtype=np.float32)
    blind = evaluate_depth(unknown, some)
    assert (blind.abs_rel, blind.delta_125, blind.rmse_log, blind.scale) == (None,) * 4
    assert (blind.num_pixels, blind.coverage) == (0, 0)
    assert evaluate_depth(some, unknown).coverage is None
    assert evaluate_depth([], []).coverage is None


def test_maps_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="depth"):
        evaluate_depth(np.ones((4, 5), np.float32), np.ones((4, 6), np.float32))
