"""Point maps are scored as a slow, obvious version and Open3D do, and None where unknown."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from laser_slam.camera import unproject
from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.dependencies import import_open3d
from laser_slam.evaluation import (
    INDOOR_POINTS,
    OUTDOOR_POINTS,
    PointErrors,
    PointMap,
    PointProtocol,
    comparable_depth,
    evaluate_points,
)
from laser_slam.sim3 import Sim3, rotation_exp, umeyama

Array = NDArray[np.float64]
DATA = os.environ.get("LASER_SLAM_DATA")
needs_data = pytest.mark.skipif(
    DATA is None, reason="LASER_SLAM_DATA does not name the data folder"
)
EVERYTHING = PointProtocol()
ELSEWHERE = Sim3(7.0, rotation_exp(np.array([0.3, -1.0, 0.4])), np.array([4.0, -2.0, 9.0]))


def wavy_surface(num: int, seed: int = 0) -> Array:
    """Make a (num, 12, 14, 3) surface without symmetries, about 3 m across, of ``num`` frames."""
    x = np.linspace(-1.5, 1.5, 12)[:, None]
    y = np.linspace(-1.0, 1.0, 14)[None]
    frames = []
    for i in range(num):
        u, v = x + 0.11 * i, y + 0.07 * i
        z = 3 + 0.3 * np.sin(2 * u + 0.5) * np.cos(1.7 * v) + 0.15 * u * v
        frames.append(np.stack(np.broadcast_arrays(u, v, z), axis=-1))
    return np.stack(frames) + 1e-3 * np.random.default_rng(seed).normal(size=(num, 12, 14, 3))


def noisy_maps(seed: int = 0, num: int = 3, noise: float = 0.02) -> list[PointMap]:
    """Predict the surface in another frame and unit, a tenth of the points 0.3 m off."""
    rng = np.random.default_rng(seed)
    truth = wavy_surface(num, seed)
    found = truth + noise * rng.normal(size=truth.shape)
    found += 0.3 * (rng.random(truth.shape[:3]) < 0.1)[..., None]
    confidence = rng.random(truth.shape[:3]).astype(np.float32)
    parts = zip(ELSEWHERE.apply(found), truth, confidence, strict=True)
    return [PointMap(*part) for part in parts]


# --- the slow version: every distance, ICP and normals by hand -----------------------------------


def slow_icp(points: Array, truth: Array, threshold: float) -> tuple[Array, float]:
    """Refine point to point; stop as Open3D does by default: 30 steps, or 1e-6 of change."""

    def partners(at: Array) -> tuple[Array, NDArray[np.intp], float, float]:
        distances = cdist(at, truth)
        nearest = distances.argmin(axis=1)
        apart = distances[np.arange(len(at)), nearest]
        near = apart < threshold
        return near, nearest, near.mean(), float(np.sqrt(np.mean(apart[near] ** 2)))

    near, nearest, fitness, rmse = partners(points)
    for _ in range(30):
        step = umeyama(points[near], truth[nearest[near]], with_scale=False)
        points = step.apply(points)
        before = fitness, rmse
        near, nearest, fitness, rmse = partners(points)
        if abs(fitness - before[0]) < 1e-6 and abs(rmse - before[1]) < 1e-6:
            break
    return points, float(fitness)


def slow_normals(points: Array) -> Array:
    """Take the direction of least spread of each point's 30 nearest, itself one of them."""
    distances = cdist(points, points)
    normals = []
    for row in distances:
        near = points[np.argsort(row)[:30]]
        normals.append(np.linalg.eigh(np.cov(near.T))[1][:, 0])
    return np.array(normals)


def slow_errors(maps: list[PointMap]) -> PointErrors:
    found = np.concatenate([each.points.reshape(-1, 3) for each in maps])
    truth = np.concatenate([each.truth.reshape(-1, 3) for each in maps])
    start = umeyama(found, truth)
    points, fitness = slow_icp(start.apply(found), truth, 0.1)
    distances = cdist(points, truth)
    cosines = np.abs(slow_normals(points) @ slow_normals(truth).T)
    there, back = distances.argmin(axis=1), distances.argmin(axis=0)
    acc, comp = distances.min(axis=1), distances.min(axis=0)
    nc_there = cosines[np.arange(len(points)), there]
    nc_back = cosines[back, np.arange(len(truth))]
    return PointErrors(
        acc_mean_m=acc.mean(),
        acc_median_m=float(np.median(acc)),
        comp_mean_m=comp.mean(),
        comp_median_m=float(np.median(comp)),
        nc_mean=(nc_there.mean() + nc_back.mean()) / 2,
        nc_median=float(np.median(nc_there) + np.median(nc_back)) / 2,
        chamfer_m=(acc.mean() + comp.mean()) / 2,
        scale=start.scale,
        icp_fitness=fitness,
    )


def assert_same(mine: PointErrors, theirs: PointErrors, tolerance: float = 1e-6) -> None:
    for name in ("acc_mean_m", "acc_median_m", "comp_mean_m", "comp_median_m", "nc_mean"):
        assert getattr(mine, name) == pytest.approx(getattr(theirs, name), abs=tolerance), name
    for name in ("nc_median", "chamfer_m", "scale", "icp_fitness"):
        assert getattr(mine, name) == pytest.approx(getattr(theirs, name), abs=tolerance), name


@pytest.mark.parametrize("seed", range(3))
def test_scores_agree_with_the_slow_version(seed: int) -> None:
    maps = noisy_maps(seed)
    assert_same(evaluate_points(maps, EVERYTHING), slow_errors(maps))


def real_room(step: int) -> list[PointMap]:
    """Take every so many-th pixel of three kitchen keyframes, 1 % of noise along the rays."""
    room = SevenScenes(Path(str(DATA)) / "7scenes/kitchen/seq-01")
    poses, intrinsics = room.info.truth, room.info.intrinsics
    assert poses is not None
    assert intrinsics is not None
    rng = np.random.default_rng(0)
    maps = []
    for frame in (0, 10, 20):
        depth = room.true_depth(frame)
        assert depth is not None
        in_cam = unproject(depth, intrinsics)[8::step, 8::step]
        world_from_cam = poses.world_from_cam[frame]
        noisy = in_cam * (1 + 0.01 * rng.normal(size=(*in_cam.shape[:2], 1)))
        truth, found = (
            p @ world_from_cam[:3, :3].T + world_from_cam[:3, 3] for p in (in_cam, noisy)
        )
        known = np.isfinite(truth).all(axis=-1)
        maps.append(PointMap(ELSEWHERE.apply(found[known][None]), truth[known][None]))
    return maps


@needs_data
def test_a_real_room_is_scored_as_the_slow_version_does() -> None:
    maps = real_room(24)
    mine = evaluate_points(maps, EVERYTHING)
    assert_same(mine, slow_errors(maps))
    assert mine.scale == pytest.approx(1 / ELSEWHERE.scale, rel=5e-3)
    assert mine.acc_mean_m is not None
    assert mine.acc_mean_m < 0.03  # 1 % of 2 m, and the grid of a thinned cloud hides some


@needs_data
def test_a_real_room_is_scored_as_open3d_does() -> None:
    assert_agrees_with_open3d(real_room(4))


def assert_agrees_with_open3d(maps: list[PointMap]) -> None:
    """Compare with Open3D's own distances and normals, after its own ICP."""
    open3d = import_open3d()
    found, truth = (
        np.concatenate([part.reshape(-1, 3) for part in parts])
        for parts in zip(*((each.points, each.truth) for each in maps), strict=True)
    )
    clouds = []
    for points in (umeyama(found, truth).apply(found), truth):
        clouds.append(open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)))
    registration = open3d.pipelines.registration
    result = registration.registration_icp(clouds[0], clouds[1], 0.1)
    clouds[0].transform(result.transformation)
    there, back = (
        np.asarray(one.compute_point_cloud_distance(other)) for one, other in (clouds, clouds[::-1])
    )
    cosines = [nearest_cosines(one, other) for one, other in (clouds, clouds[::-1])]
    mine = evaluate_points(maps, EVERYTHING)
    assert mine.nc_mean == pytest.approx(np.mean([each.mean() for each in cosines]), abs=1e-6)
    assert mine.nc_median == pytest.approx(np.mean([np.median(each) for each in cosines]), abs=1e-6)
    assert mine.acc_mean_m == pytest.approx(there.mean(), abs=1e-6)
    assert mine.acc_median_m == pytest.approx(np.median(there), abs=1e-6)
    assert mine.comp_mean_m == pytest.approx(back.mean(), abs=1e-6)
    assert mine.comp_median_m == pytest.approx(np.median(back), abs=1e-6)
    assert mine.icp_fitness == pytest.approx(result.fitness, abs=1e-6)


def nearest_cosines(cloud: Any, other: Any) -> Array:
    """Return |cosine| of each point's normal and its nearest one's, both as Open3D finds them."""
    for each in (cloud, other):
        each.estimate_normals()
    tree = import_open3d().geometry.KDTreeFlann(other)
    nearest = [tree.search_knn_vector_3d(point, 1)[1][0] for point in np.asarray(cloud.points)]
    normals = np.asarray(cloud.normals), np.asarray(other.normals)[nearest]
    return np.asarray(np.abs((normals[0] * normals[1]).sum(axis=1)))


@pytest.mark.parametrize("seed", range(3))
def test_scores_agree_with_open3d(seed: int) -> None:
    assert_agrees_with_open3d(noisy_maps(seed))


# --- laws ----------------------------------------------------------------------------------------


def test_a_perfect_map_has_no_error_in_any_frame_and_unit() -> None:
    truth = wavy_surface(3)
    for unit in (0.01, 1.0, 100.0):
        moved = Sim3(unit, ELSEWHERE.rotation, ELSEWHERE.translation).apply(truth)
        maps = [PointMap(*part) for part in zip(moved, truth, strict=True)]
        errors = evaluate_points(maps, EVERYTHING)
        assert errors.scale == pytest.approx(1 / unit)
        assert errors.chamfer_m == pytest.approx(0, abs=1e-9)
        assert errors.nc_mean == pytest.approx(1, abs=1e-6)
        assert errors.icp_fitness == 1
        assert errors.num_points == errors.num_truth == 3 * 12 * 14


def test_the_frame_and_unit_of_the_prediction_change_no_score() -> None:
    maps = noisy_maps()
    plain = evaluate_points(maps, EVERYTHING)
    for seed, unit in enumerate((0.01, 100.0)):
        rng = np.random.default_rng(seed)
        move = Sim3(unit, rotation_exp(rng.normal(size=3)), rng.normal(size=3))
        moved = [PointMap(move.apply(each.points), each.truth) for each in maps]
        other = evaluate_points(moved, EVERYTHING)
        assert other.scale == pytest.approx(plain.scale / unit if plain.scale else None)
        assert other.acc_mean_m == pytest.approx(plain.acc_mean_m, abs=1e-9)
        assert other.comp_median_m == pytest.approx(plain.comp_median_m, abs=1e-9)
        assert other.nc_mean == pytest.approx(plain.nc_mean, abs=1e-6)


def test_the_order_of_frames_and_pixels_does_not_matter() -> None:
    maps = noisy_maps()
    mixed = [PointMap(each.points[::-1], each.truth[::-1]) for each in reversed(maps)]
    assert_same(evaluate_points(mixed, EVERYTHING), evaluate_points(maps, EVERYTHING))


def test_more_noise_is_more_error() -> None:
    errors = [evaluate_points(noisy_maps(noise=noise), EVERYTHING) for noise in (0.005, 0.02, 0.05)]
    for name, sign in (("acc_mean_m", 1), ("comp_mean_m", 1), ("chamfer_m", 1), ("nc_mean", -1)):
        first, second, third = (sign * getattr(each, name) for each in errors)
        assert first < second < third, name


def test_icp_brings_back_what_outliers_pulled_away() -> None:
    """A sixth of the points is 0.6 m off to one side and moves the alignment by 0.1 m."""
    truth = wavy_surface(4)
    found = truth.copy()
    found[:, :, :2] += [0.0, 0.0, 0.6]
    maps = [PointMap(*part) for part in zip(found, truth, strict=True)]
    refined = evaluate_points(maps, EVERYTHING)
    without = evaluate_points(maps, PointProtocol(icp_threshold_m=1e-9))
    assert without.icp_fitness == 0
    assert refined.acc_median_m is not None
    assert without.acc_median_m is not None
    assert refined.acc_median_m < 0.5 * without.acc_median_m


# --- what is compared ----------------------------------------------------------------------------


def test_only_the_central_square_is_compared_indoors() -> None:
    """The square is 224 pixels of maps 518 pixels wide; garbage around it does not matter."""
    x, y = np.meshgrid(np.linspace(-2, 2, 518), np.linspace(-1.5, 1.5, 388))
    truth: Array = np.stack([x, y, 3 + 0.3 * np.sin(2 * x) * np.cos(3 * y)], axis=-1)
    found: Array = 1e3 * np.random.default_rng(0).normal(size=truth.shape)
    inside = slice(194 - 112, 194 + 112), slice(259 - 112, 259 + 112)
    found[inside] = truth[inside]
    protocol = PointProtocol(crop_share=INDOOR_POINTS.crop_share, has_normals=False)
    errors = evaluate_points([PointMap(found, truth)], protocol)
    assert errors.num_truth == 224 * 224
    assert errors.chamfer_m == pytest.approx(0, abs=1e-9)
    half = evaluate_points([PointMap(truth[::2, ::2], truth[::2, ::2])], protocol)
    assert half.num_truth == 112 * 112


def test_the_least_confident_two_fifths_are_left_out_outdoors() -> None:
    rng = np.random.default_rng(0)
    truth = wavy_surface(5)
    confidence = rng.permutation(truth[..., 0].size).reshape(truth.shape[:3]) / truth[..., 0].size
    found = np.where((confidence < 0.4)[..., None], rng.normal(size=truth.shape), truth)
    parts = zip(found, truth, confidence.astype(np.float32), strict=True)
    errors = evaluate_points((PointMap(*part) for part in parts), OUTDOOR_POINTS)
    assert errors.num_points == errors.num_truth == pytest.approx(0.6 * confidence.size, abs=1)
    assert errors.chamfer_m == pytest.approx(0, abs=1e-9)
    assert errors.nc_mean is None
    assert errors.nc_median is None


@pytest.mark.parametrize("num_rows", [1, 5, 11])
def test_what_is_not_predicted_is_never_dropped_for_its_confidence(num_rows: int) -> None:
    """Two fifths of what is predicted go; whoever predicts only easy pixels keeps the gaps."""
    maps = noisy_maps(num=1)
    maps[0].points[:num_rows] = np.nan
    errors = evaluate_points(maps, OUTDOOR_POINTS)
    assert errors.num_points == pytest.approx(0.6 * (12 - num_rows) * 14, abs=1)
    assert errors.num_truth == errors.num_points + num_rows * 14
    assert errors.coverage == pytest.approx(1 - num_rows / 12)


def test_a_point_of_unknown_confidence_goes_first() -> None:
    maps = noisy_maps(num=1)
    confidence = maps[0].confidence
    assert confidence is not None
    confidence[2:5] = np.nan
    maps[0].points[2:5] += 100.0
    errors = evaluate_points(maps, OUTDOOR_POINTS)
    assert errors.num_points == errors.num_truth == pytest.approx(0.6 * 12 * 14, abs=1)
    assert errors.chamfer_m is not None
    assert errors.chamfer_m < 0.2


def test_confidence_is_compared_over_all_frames_together() -> None:
    """The frame that is sure of nothing loses all of its points, the other none of the best."""
    sure, unsure = noisy_maps(num=2)
    assert sure.confidence is not None
    assert unsure.confidence is not None
    sure.confidence[:] = np.linspace(0.8, 1.0, 12 * 14).reshape(12, 14)
    unsure.confidence[:] = np.linspace(0.0, 0.4, 12 * 14).reshape(12, 14)
    alone = evaluate_points([sure], PointProtocol(has_normals=False))
    both = evaluate_points([sure, unsure], PointProtocol(dropped_share=0.5, has_normals=False))
    assert both.num_points == 12 * 14
    assert both.chamfer_m == pytest.approx(alone.chamfer_m, abs=1e-9)


def test_dropping_by_confidence_needs_confidence() -> None:
    maps = [PointMap(each.points, each.truth) for each in noisy_maps()]
    with pytest.raises(ValueError, match="there is no confidence"):
        evaluate_points(maps, OUTDOOR_POINTS)


def test_a_hole_in_the_prediction_costs_completeness_and_not_accuracy() -> None:
    truth = wavy_surface(1)
    whole = truth.copy()
    whole[:, 4:8, 4:8, 1] = np.nan
    holed = evaluate_points([PointMap(whole[0], truth[0])], EVERYTHING)
    assert holed.num_points == 12 * 14 - 16
    assert holed.num_truth == 12 * 14
    assert holed.coverage == pytest.approx(1 - 16 / (12 * 14))
    assert holed.acc_mean_m == pytest.approx(0, abs=1e-9)
    assert holed.comp_mean_m is not None
    assert holed.comp_mean_m > 0.02
    assert holed.comp_median_m == pytest.approx(0, abs=1e-9)


def test_true_depth_beyond_ten_metres_is_not_compared_indoors() -> None:
    depth = np.array([[0.5, 10.0, 10.1], [np.nan, 0.0, -1.0]], dtype=np.float32)
    left = comparable_depth(depth, INDOOR_POINTS)
    np.testing.assert_array_equal(left, [[0.5, 10.0, np.nan], [np.nan] * 3])
    np.testing.assert_array_equal(
        comparable_depth(depth, EVERYTHING), np.where(depth > 0, depth, np.nan)
    )


def test_the_deepest_fiftieth_of_all_pixels_is_not_compared_outdoors() -> None:
    """Unknown pixels count as near: of a laser that sees every tenth pixel, a fifth goes."""
    depth = np.zeros((100, 100), dtype=np.float32)
    depth[:, ::10] = np.random.default_rng(0).uniform(1, 70, (100, 10))
    left = comparable_depth(depth, OUTDOOR_POINTS)
    assert np.isfinite(left).sum() == pytest.approx(800, abs=1)
    assert np.nanmax(left) < np.sort(depth[depth > 0])[-199]


def test_a_laser_that_sees_fewer_pixels_than_are_too_far_loses_none() -> None:
    """The published limit is then at depth 0, and is not used."""
    depth = np.zeros((100, 100), dtype=np.float32)
    depth[50, :150] = 30.0
    assert np.isfinite(comparable_depth(depth, OUTDOOR_POINTS)).sum() == 100


def test_a_frame_without_any_prediction_counts_for_completeness() -> None:
    maps = noisy_maps(num=2, noise=0.0)
    whole = evaluate_points(maps, EVERYTHING)
    lost = PointMap(np.full_like(maps[1].points, np.nan), maps[1].truth)
    half = evaluate_points([maps[0], lost], EVERYTHING)
    assert (half.num_frames, half.num_predicted, half.coverage) == (2, 1, 0.5)
    assert (whole.num_frames, whole.num_predicted, whole.coverage) == (2, 2, 1.0)
    assert half.num_truth == whole.num_truth
    assert half.comp_mean_m is not None
    assert whole.comp_mean_m is not None
    assert half.comp_mean_m > whole.comp_mean_m


def test_unknown_truth_is_not_compared() -> None:
    maps = noisy_maps(num=1)
    maps[0].truth[2, 3, 0] = np.nan
    maps[0].truth[5, 1, 2] = np.inf
    assert evaluate_points(maps, EVERYTHING).num_truth == 12 * 14 - 2


@pytest.mark.parametrize(
    ("maps", "reason"),
    [
        ([], "needs 3 points, got 0"),
        ([PointMap(np.full((4, 5, 3), np.nan), np.ones((4, 5, 3)))], "needs 3 points, got 0"),
        ([PointMap(np.ones((4, 5, 3)), np.full((4, 5, 3), np.nan))], "needs 3 points, got 0"),
        ([PointMap(np.ones((4, 5, 3)), np.ones((4, 5, 3)))], "more than one place"),
    ],
)
def test_nothing_to_compare_is_none_with_a_reason(maps: list[PointMap], reason: str) -> None:
    for protocol in (EVERYTHING, INDOOR_POINTS):
        errors = evaluate_points(maps, protocol)
        assert errors.reason is not None
        assert reason in errors.reason
        for name in ("acc_mean_m", "comp_median_m", "nc_mean", "chamfer_m", "scale"):
            assert getattr(errors, name) is None


def test_maps_of_different_sizes_are_refused() -> None:
    points = np.ones((4, 5, 3))
    with pytest.raises(ValueError, match="truth"):
        PointMap(points, np.ones((4, 6, 3)))
    with pytest.raises(ValueError, match="confidence"):
        PointMap(points, points, np.ones((4, 6), np.float32))
