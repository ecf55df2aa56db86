import numpy as np
import pytest
from ablate_street import changed_cases, read_settings
from street import (
    CASES,
    GROUND,
    KITTI_SIZE,
    OVERLAP,
    SKY,
    SKY_M,
    WINDOW,
    Case,
    Pair,
    make_pair,
    rotation_error_deg,
    score,
    true_drive,
)
from typer import BadParameter

from laser_slam.camera import project, unproject
from laser_slam.config import RegistrationConfig
from laser_slam.registration import register
from laser_slam.sim3 import rotation_log
from laser_slam.types import Prediction

SIZE = (77, 259)
CLEAN = Case(noise=0.0, pose_deg=0.0, pose_m=0.0)


def world_points(frame: int) -> np.ndarray:
    drive = true_drive(0, SIZE)
    pose = drive.world_from_cam[frame]
    points = unproject(drive.depth[frame].astype(np.float32), drive.intrinsics)
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def log_ratio(pair: Pair, window: Prediction, scale: float = 1.0) -> np.ndarray:
    return np.asarray(np.log(scale * window.depth / pair.truth(window)))


def test_every_frame_sees_ground_sky_and_a_dozen_objects_before_the_sky() -> None:
    drive = true_drive(0, SIZE)
    assert len(drive.depth) == 2 * WINDOW - OVERLAP
    assert (drive.depth > 0).all()
    assert (drive.depth[drive.ids == SKY] == SKY_M).all()
    assert (drive.depth[drive.ids != SKY] < SKY_M).all()
    for ids in drive.ids:
        assert {SKY, GROUND} < set(np.unique(ids))
        assert len(np.unique(ids)) > 12


def test_the_ground_lies_flat_165_centimetres_below_the_camera() -> None:
    for frame in (0, 17, 34):
        points = world_points(frame)
        is_ground = true_drive(0, SIZE).ids[frame] == GROUND
        np.testing.assert_allclose(points[is_ground, 1], 1.65, atol=1e-6)
        assert (points[~is_ground, 1] < 1.65 + 1e-6).sum() > 0.9 * (~is_ground).sum()


@pytest.mark.parametrize(("first", "second"), [(0, 4), (12, 15), (34, 33)])
def test_a_point_seen_from_two_frames_is_one_point_of_one_object(first: int, second: int) -> None:
    drive = true_drive(0, SIZE)
    pose = drive.world_from_cam[second]
    cam = (world_points(first) - pose[:3, 3]) @ pose[:3, :3]
    pixels = project(cam, drive.intrinsics)
    col, row = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).transpose(2, 0, 1)
    inside = (col >= 1) & (row >= 1) & (col < SIZE[1] - 1) & (row < SIZE[0] - 1)
    inside &= drive.ids[first] != SKY
    row, col = row[inside], col[inside]
    own = drive.ids[first][inside]
    around = [drive.ids[second][row + i, col + j] == own for i in (-1, 0, 1) for j in (-1, 0, 1)]
    alone = np.all(around, axis=0)
    gap = np.abs(np.log(cam[inside][:, 2] / drive.depth[second][row, col]))
    assert alone.mean() > 0.6
    assert np.median(gap[alone]) < 0.02  # half a pixel on the ground
    # Nobody sees through walls; posts thinner than a pixel may slip through.
    elsewhere = ~np.any(around, axis=0)
    assert (elsewhere & (drive.depth[second][row, col] > cam[inside][:, 2])).mean() < 0.01


def test_without_noise_the_windows_are_the_truth_in_two_frames_and_units() -> None:
    pair = make_pair(Case(noise=0.0, pose_deg=0.0, pose_m=0.0, blur_px=0.3), 1, SIZE)
    scale = pair.previous_from_current.scale
    assert abs(np.log(scale)) > 0.01
    for window, unit in ((pair.previous, 1.0), (pair.current, scale)):
        assert np.median(np.abs(log_ratio(pair, window, unit))) < 1e-6
    shared = pair.previous_from_current.apply_poses(pair.current.window_from_cam[:OVERLAP])
    np.testing.assert_allclose(shared, pair.previous.window_from_cam[-OVERLAP:], atol=1e-9)


def test_an_object_has_one_factor_within_the_limits() -> None:
    pair = make_pair(Case("objects", noise=0.0), 0, SIZE)
    ids = pair.ids(pair.current)
    for name in np.unique(ids):
        assert np.ptp(pair.factors[ids == name]) == 0
    assert len(np.unique(pair.factors)) == len(np.unique(ids))
    assert 1.3 < pair.factors.max() / pair.factors.min() <= 1.25**2
    assert np.median(pair.factors[ids != SKY]) == pytest.approx(1)
    found = np.exp(log_ratio(pair, pair.current, pair.previous_from_current.scale))
    assert np.median(np.abs(found / pair.factors - 1)) < 1e-6
    assert np.median(np.abs(log_ratio(pair, pair.previous))) < 1e-6


def test_bands_and_smooth_factors_follow_depth_alone() -> None:
    depth = true_drive(0, SIZE).depth[WINDOW - OVERLAP :]
    order = np.argsort(depth, axis=None)
    bands = make_pair(Case("bands"), 0, SIZE).factors.ravel()[order]
    assert np.count_nonzero(np.diff(bands)) == 5
    smooth = np.log(make_pair(Case("smooth"), 0, SIZE).factors.ravel()[order])
    assert np.ptp(smooth) > 0.15
    slopes = np.abs(np.diff(smooth)) / np.maximum(np.diff(np.log(depth.ravel()[order])), 1e-12)
    assert slopes.max() < 1.0


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_noise_is_as_large_as_it_is_called(noise: float) -> None:
    clean, noisy = (make_pair(Case(noise=size), 0, SIZE) for size in (0.0, noise))
    for name in ("previous", "current"):
        ratio = np.log(getattr(noisy, name).depth / getattr(clean, name).depth)
        assert ratio.std() == pytest.approx(noise, rel=0.05)
        beside = ratio[:, :, 1:] - ratio[:, :, :-1]  # what is left is the independent half
        assert beside.std() == pytest.approx(noise, rel=0.1)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_fill_their_share_of_both_windows_each_on_its_own(share: float) -> None:
    clean, wrong = (make_pair(Case(noise=0.0, outliers=part), 0, SIZE) for part in (0.0, share))
    masks = []
    for name in ("previous", "current"):
        ratio = getattr(wrong, name).depth / getattr(clean, name).depth
        masks.append(np.abs(ratio - 1) > 1e-5)
        assert masks[-1].mean() == pytest.approx(share, rel=0.1)
        assert 2 < ratio.max() < 3 < 1 / ratio.min() * 1.5
    both = (masks[0][-OVERLAP:] & masks[1][:OVERLAP]).mean()
    assert both < 0.8 * min(masks[0][-OVERLAP:].mean(), masks[1][:OVERLAP].mean())


def test_confidence_falls_with_error_but_for_outliers_only_where_told() -> None:
    plain, told = (
        make_pair(Case(outliers=0.3, outlier_confidence=part), 0, SIZE) for part in (1.0, 0.3)
    )
    lowered = told.current.confidence < 0.5 * plain.current.confidence
    is_known = plain.ids(plain.current) != SKY
    assert lowered[is_known].mean() == pytest.approx(0.3, abs=0.05)
    rigid = make_pair(Case(), 0, SIZE)
    error = np.abs(log_ratio(rigid, rigid.previous))
    doubted = rigid.previous.confidence < np.quantile(rigid.previous.confidence[is_known], 0.2)
    assert error[doubted & is_known].mean() > 2 * error[~doubted & is_known].mean()
    assert rigid.current.confidence[~is_known].max() < 0.1


def test_pose_noise_is_as_large_as_it_is_called() -> None:
    case = Case(noise=0.0, pose_deg=0.5, pose_m=0.2)
    clean, noisy = (make_pair(chosen, 0, SIZE).previous.window_from_cam for chosen in (CLEAN, case))
    gap = np.linalg.inv(clean) @ noisy
    assert np.degrees(rotation_log(gap[:, :3, :3])).std() == pytest.approx(0.5, rel=0.3)
    assert (gap[:, :3, 3] / case.unit).std() == pytest.approx(0.2, rel=0.3)


def test_another_unit_changes_nothing_else() -> None:
    pair, large = (make_pair(Case("objects", unit=unit), 0, SIZE) for unit in (0.1, 100.0))
    np.testing.assert_allclose(large.current.depth, 1000 * pair.current.depth, rtol=1e-6)
    np.testing.assert_array_equal(large.current.confidence, pair.current.confidence)
    assert large.previous_from_current.scale == pair.previous_from_current.scale
    scale = pair.previous_from_current.scale
    assert score(large, large.current, scale).new == pytest.approx(
        score(pair, pair.current, scale).new, rel=1e-5
    )


def test_scores_know_what_was_put_in() -> None:
    pair = make_pair(Case("objects", noise=0.0, blur_px=0.3), 0, SIZE)
    errors = score(pair, pair.current, pair.previous_from_current.scale)
    is_known = pair.ids(pair.current) != SKY
    put_in = [
        np.abs(pair.factors[part][is_known[part]] - 1).mean()
        for part in (slice(None, OVERLAP), slice(OVERLAP, None))
    ]
    assert [errors.overlap, errors.new] == pytest.approx(put_in, abs=2e-3)
    logs = np.abs(np.log(pair.factors[:OVERLAP][is_known[:OVERLAP]])).mean()
    assert errors.layer_overlap == pytest.approx(logs, abs=2e-3)
    assert rotation_error_deg(pair, pair.previous_from_current) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "overlap", "new"),
    [
        ("rigid, noise 1 %", 0.0153, 0.0151),
        ("rigid, outliers 10 %", 0.0754, 0.0708),
        ("objects, noise 1 %", 0.1003, 0.0988),
        ("6 depth bands", 0.0985, 0.1032),
    ],
)
def test_the_cases_are_as_hard_as_those_that_the_targets_come_from(
    name: str, overlap: float, new: float
) -> None:
    found = []
    for pair in (make_pair(CASES[name], seed, KITTI_SIZE) for seed in range(3)):
        measured = register(pair.previous, pair.current, RegistrationConfig())
        errors = score(pair, pair.current, measured.previous_from_current.scale)
        found.append([errors.overlap, errors.new])
    assert np.mean(found, axis=0) == pytest.approx([overlap, new], rel=0.12)


def test_the_table_takes_every_combination_of_changes() -> None:
    rows = dict(changed_cases("6 depth", ["unit=0.01,100", "outliers=0.1"]))
    assert [(case.factors, case.unit, case.outliers) for case in rows.values()] == [
        ("bands", 0.01, 0.1),
        ("bands", 100.0, 0.1),
    ]
    assert "6 depth bands, unit 100, outliers 0.1" in rows
    assert len(dict(changed_cases("", []))) == len(CASES)


@pytest.mark.parametrize(("cases", "change"), [("nonsense", "unit=1"), ("", "factors=1")])
def test_the_table_refuses_what_it_does_not_know(cases: str, change: str) -> None:
    with pytest.raises(BadParameter, match=r"no case 'nonsense'|no number 'factors'"):
        list(changed_cases(cases, [change]))


def test_settings_may_carry_assignments_of_their_own() -> None:
    config = read_settings("paper,windows.size=30", ["windows.overlap=7"])
    assert config.registration.scale == "huber"
    assert (config.windows.size, config.windows.overlap) == (30, 7)
