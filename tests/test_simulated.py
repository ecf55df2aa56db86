"""The simulated backbone: each error has the size that its setting says, and nothing else has."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from corridor import SIZE, Corridor, true_intrinsics, true_pose, view
from numpy.typing import NDArray
from quick_runs import leave_pictures_out
from rendered import RenderedDrive
from scipy.stats import spearmanr

from laser_slam.backbones import make_backbone
from laser_slam.backbones.simulated import SimulatedBackbone
from laser_slam.backbones.simulated.backbone import SIMULATED
from laser_slam.backbones.simulated.fields import add_blobs, smooth_maps
from laser_slam.backbones.simulated.gravity import guess_down, settle_down
from laser_slam.backbones.simulated.piece_kernels import GROUND_TAG
from laser_slam.camera import resize_intrinsics
from laser_slam.config import load_config
from laser_slam.datasets.base import Dataset
from laser_slam.errors import ConfigError
from laser_slam.pipeline import Pipeline
from laser_slam.sim3 import Sim3, rotation_exp, rotation_log
from laser_slam.types import Prediction, SequenceInfo, Trajectory, WindowStatus

Map = NDArray[np.float32]

WIDTH = 252  # 18 patches: small and quick
NOTHING = {
    name: 0.0
    for name in (
        "scale_sigma smooth_sigma layer_sigma noise_smooth noise_iid edge_blur_px blob_share "
        "pose_rotation_deg pose_translation drift_rotation_deg drift_translation persistence"
    ).split()
}
FRAMES = np.arange(10)


def backbone(dataset: Dataset | None = None, /, **settings: object) -> SimulatedBackbone:
    """Build one without any error but those of ``settings``."""
    source = dataset or Corridor(60)
    chosen = {"width": WIDTH, **NOTHING, **settings}
    names = [f"backbone.simulated.{name}={value}" for name, value in chosen.items()]
    config = load_config(assignments=["backbone.name=simulated", *names]).backbone
    made = make_backbone(config, source.info, source.true_depth)
    assert isinstance(made, SimulatedBackbone)
    return made


def predict(made: SimulatedBackbone, first: int = 0, num: int = 10) -> Prediction:
    return made.predict([], np.arange(first, first + num), None)


def truth(made: SimulatedBackbone, prediction: Prediction) -> Map:
    return np.stack(made._truth.window(prediction.frames).depths)


def log_errors(made: SimulatedBackbone, prediction: Prediction) -> NDArray[np.float64]:
    """Return (N, H, W) log of predicted over true depth, 0 in the median."""
    ratios = np.log(prediction.depth / truth(made, prediction)).astype(np.float64)
    return np.asarray(ratios - np.nanmedian(ratios))


@pytest.fixture(scope="module")
def street(short_drive: RenderedDrive) -> Dataset:
    """The rendered street as a data set."""
    num = len(short_drive.depths)
    frames = np.arange(num)

    class Street(Corridor):
        @property
        def info(self) -> SequenceInfo:
            size = short_drive.depths.shape[1], short_drive.depths.shape[2]
            poses = Trajectory(frames, frames / 10, short_drive.world_from_cam)
            return SequenceInfo("street", size, num, short_drive.intrinsics, "given", poses)

        def true_depth(self, frame: int) -> Map | None:
            return np.array(short_drive.depths[frame])

    return Street(num)


# --- the truth ----------------------------------------------------------------------------------


def test_without_errors_depth_and_path_are_the_truth_in_median_depths() -> None:
    made = backbone()
    prediction = predict(made, first=7)
    true = truth(made, prediction)
    unit_m = np.median(true[:, ::4, ::4])
    np.testing.assert_allclose(prediction.depth, true / unit_m, rtol=1e-5)
    poses = np.stack([true_pose(frame) for frame in prediction.frames])
    expected = (Sim3(scale=1 / float(unit_m)) @ Sim3.from_matrix(poses[0]).inverse()).apply_poses(
        poses
    )
    np.testing.assert_allclose(prediction.window_from_cam, expected, atol=1e-6)


def test_true_depth_is_that_of_the_nearest_pixel() -> None:
    """An average over a depth edge would be a surface that is nowhere."""
    made = backbone(width=70)
    true = truth(made, predict(made))
    assert set(np.unique(true[3])) <= set(np.unique(view(3)[1]))


@pytest.mark.parametrize(
    ("size", "expected"),
    [((376, 1241), (154, 518)), ((480, 640), (392, 518)), ((9, 900), (14, 518))],
)
def test_depth_maps_are_whole_patches_high(size: tuple[int, int], expected: object) -> None:
    assert backbone(width=518).image_size(size) == expected


def test_intrinsics_are_the_given_ones_per_axis() -> None:
    made = backbone()
    size = made.image_size(SIZE)
    calibration = made.calibrate(iter([]), None)
    assert calibration.intrinsics is not None
    expected = resize_intrinsics(true_intrinsics(), SIZE, size)
    assert expected[0, 0] != pytest.approx(expected[1, 1], rel=1e-3)  # the axes do differ
    np.testing.assert_allclose(calibration.intrinsics, expected)
    np.testing.assert_allclose(predict(made).intrinsics[4], expected)
    given = true_intrinsics()
    given_back = made.calibrate(iter([]), given).intrinsics
    assert given_back is not None
    np.testing.assert_array_equal(given_back, given)


def test_a_window_is_the_same_whenever_it_is_asked_for() -> None:
    def made() -> SimulatedBackbone:
        names = {name: value for name, value in DEFAULTS.items() if name != "width"}
        return backbone(**names)

    forth = made()
    first, second = predict(forth, 0), predict(forth, 5)
    back = made()
    again_second, again_first = predict(back, 5), predict(back, 0)
    for one, other in ((first, again_first), (second, again_second)):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.confidence, other.confidence)
        np.testing.assert_array_equal(one.window_from_cam, other.window_from_cam)
    other_seed = predict(backbone(**{**DEFAULTS, "width": WIDTH, "seed": 1}), 0)
    assert not np.allclose(other_seed.depth, first.depth, rtol=1e-3)


DEFAULTS = load_config().backbone.simulated.model_dump()


def test_it_says_once_that_it_is_no_reconstruction() -> None:
    made = backbone()
    assert SIMULATED in predict(made, 3).warnings
    assert predict(made, 4).warnings == ()


# --- each strength ------------------------------------------------------------------------------


def spread_over_windows(measure: Callable[[int], float], num: int = 30) -> float:
    return float(np.std([measure(window) for window in range(num)]))


def test_the_unit_varies_from_window_to_window_by_its_setting() -> None:
    made = backbone(scale_sigma=0.3, width=56)

    def log_unit(first: int) -> float:
        prediction = predict(made, first, 2)
        return float(np.log(np.median(prediction.depth[:, ::4, ::4])))

    assert 0.2 < spread_over_windows(log_unit, 50) < 0.4
    prediction = predict(made, 11)
    true = truth(made, prediction)
    steps = np.linalg.norm(np.diff(prediction.window_from_cam[:, :3, 3], axis=0), axis=1)
    true_steps = np.linalg.norm(
        np.diff([true_pose(frame)[:3, 3] for frame in prediction.frames], axis=0), axis=1
    )
    scale = np.median(prediction.depth / true)
    np.testing.assert_allclose(steps / true_steps, scale, rtol=1e-4)


def test_smooth_errors_depend_on_depth_alone_and_have_their_size() -> None:
    made, errors = backbone(smooth_sigma=0.1), []
    for first in range(0, 50, 2):
        prediction = predict(made, first, 2)
        ratios = np.log(prediction.depth / truth(made, prediction))
        errors.append(np.median(ratios[:, ::4, ::4]) + np.log(np.median(truth(made, prediction))))
    assert 0.06 < np.std(errors) < 0.14
    prediction = predict(made)
    depth, ratio = truth(made, prediction)[0].ravel(), log_errors(made, prediction)[0].ravel()
    order = np.argsort(depth)
    # As steep as a curve of this size may be over knots 1.1 apart, and the same at equal depth.
    slopes = np.abs(np.diff(ratio[order])) - 0.5 * np.diff(np.log(depth[order]))
    assert slopes.max() < 1e-5
    assert np.ptp(ratio) > 0.01


@pytest.mark.parametrize("law", ["uniform", "normal"])
def test_bands_have_factors_of_their_size_and_borders_in_log_depth(law: str) -> None:
    made = backbone(layers="bands", layer_sigma=0.1, layer_law=law, band_width=0.3)
    factors = []
    for first in range(30):
        prediction = predict(made, first, 3)
        true = truth(made, prediction)
        band = np.floor(np.log(true / np.median(true[:, ::4, ::4])) / 0.3 + 1e-6)
        ratio = np.log(prediction.depth / true) + np.log(np.median(true[:, ::4, ::4]))
        for one in np.unique(band):
            inside = ratio[band == one]
            if len(inside) > 100:
                assert np.quantile(inside, 0.95) - np.quantile(inside, 0.05) < 1e-4
                factors.append(float(np.median(inside)))
    assert 0.085 < np.std(factors) < 0.115
    assert abs(np.mean(factors)) < 0.02
    limit = 0.1 * np.sqrt(3) + 1e-4
    assert (np.abs(factors).max() < limit) == (law == "uniform")


def test_a_surface_point_is_in_one_piece_in_every_frame_of_a_window(street: Dataset) -> None:
    """Warp pixels from frame to frame by the truth: the factor on their depth goes along."""
    made = backbone(street, layer_sigma=0.2, layers="objects", width=518)
    prediction = predict(made, 0, 8)
    true, errors = truth(made, prediction), log_errors(made, prediction)
    window, K = made._truth.window(prediction.frames), prediction.intrinsics[0]
    v, u = np.mgrid[: true.shape[1] : 3, : true.shape[2] : 3].reshape(2, -1)
    for second in (1, 4, 7):
        z = true[0][v, u].astype(float)
        points = np.linalg.solve(K, np.stack([u, v, np.ones_like(u)])) * z
        to_second = np.linalg.inv(window.world_from_cam[second]) @ window.world_from_cam[0]
        moved = to_second[:3, :3] @ points + to_second[:3, 3:]
        x, y = np.rint(np.nan_to_num((K @ moved)[:2] / moved[2], nan=-1)).astype(int)
        fits = (moved[2] > 0) & (x >= 0) & (x < true.shape[2]) & (y >= 0) & (y < true.shape[1])
        x, y = np.where(fits, x, 0), np.where(fits, y, 0)
        fits &= np.abs(true[second][y, x] / moved[2] - 1) < 0.003
        same = np.abs(errors[0][v, u] - errors[second][y, x])[fits] < 1e-4
        assert fits.sum() > 1000
        assert same.mean() > 0.97  # the rest lies within a pixel of a border


def test_pieces_are_like_objects_and_the_ground_is_in_few(street: Dataset) -> None:
    made = backbone(street, layer_sigma=0.1, width=518)
    window = made._truth.window(FRAMES)
    K = made._truth.intrinsics
    ground = made._pieces.ground(window.depths, K, window.world_from_cam)
    keys = made._pieces.keys(window.depths[4], K, window.world_from_cam[4], ground)
    is_ground = (keys & GROUND_TAG) > 0
    down = (made._pieces.level_from_world @ window.world_from_cam[4][:3, :3])[1]
    rays = np.linalg.inv(K) @ np.stack(
        [*np.meshgrid(np.arange(518), np.arange(keys.shape[0])), np.ones(keys.shape)]
    ).reshape(3, -1)
    below_m = (down @ rays).reshape(keys.shape) * window.depths[4]
    street_level = np.nanquantile(below_m[-20:], 0.5)
    near = window.depths[4] < 2 * window.median_m
    flat = near & (np.abs(below_m - street_level) < 0.05)
    upright = near & (below_m < street_level - 1.0)
    assert is_ground[flat].mean() > 0.9
    assert is_ground[upright].mean() < 0.05
    assert len(np.unique(keys[is_ground])) <= 6
    assert 20 < len(np.unique(keys[(keys > 0) & ~is_ground])) < 300


@pytest.mark.parametrize("axis", range(3))
def test_down_is_found_though_the_camera_is_held_askew(
    short_drive: RenderedDrive, axis: int
) -> None:
    tilt = rotation_exp(np.radians(20) * np.eye(3)[axis])
    poses, depths = short_drive.world_from_cam[::6], list(short_drive.depths[::6])
    true_down = guess_down(poses)  # the cameras on a car are level
    askew = tilt @ true_down
    found = settle_down(askew, depths, short_drive.intrinsics, poses)
    assert np.degrees(np.arccos(min(1.0, float(found @ true_down)))) < 4.0
    blank = [np.full_like(depths[0], np.nan)]
    unmoved = settle_down(askew, blank, short_drive.intrinsics, poses[:1])
    np.testing.assert_array_equal(unmoved, askew)


def test_objects_have_factors_of_their_size(street: Dataset) -> None:
    made = backbone(street, layer_sigma=0.1, object_size=0.25, scale_sigma=0.0)
    window = made._truth.window(FRAMES)
    ground = made._pieces.ground(window.depths, made._truth.intrinsics, window.world_from_cam)
    keys = np.stack(
        [
            made._pieces.keys(depth, made._truth.intrinsics, pose, ground)
            for depth, pose in zip(window.depths, window.world_from_cam, strict=True)
        ]
    )
    prediction = made.predict([], FRAMES, None)
    ratio = np.log(prediction.depth / np.stack(window.depths)) + np.log(window.median_m)
    known = keys > 0
    pieces, first = np.unique(keys[known], return_index=True)
    assert len(pieces) > 100
    assert 0.085 < np.std(ratio[known][first]) < 0.115


def test_smooth_noise_has_its_size_and_reach() -> None:
    made = backbone(noise_smooth=0.05, noise_px=20)
    prediction = predict(made, 0, 20)
    true = truth(made, prediction)
    errors = np.log(prediction.depth / true)
    at_median = np.abs(np.log(true / np.median(true))) < 0.2
    assert 0.04 < np.std(errors[at_median]) < 0.06
    plain = errors - errors.mean()
    near = np.mean(plain[:, :, 4:] * plain[:, :, :-4]) / plain.var()
    far = np.mean(plain[:, :, 60:] * plain[:, :, :-60]) / plain.var()
    assert near > 0.8
    assert abs(far) < 0.2
    frames = np.corrcoef(plain[0].ravel(), plain[1].ravel())[0, 1]
    assert abs(frames) < 0.35


def test_iid_noise_has_its_size_and_no_reach() -> None:
    made = backbone(noise_iid=0.03)
    prediction = predict(made)
    true = truth(made, prediction)
    errors = np.log(prediction.depth / true)
    at_median = np.abs(np.log(true / np.median(true))) < 0.2
    assert 0.025 < np.std(errors[at_median]) < 0.036
    plain = errors - errors.mean()
    assert abs(np.mean(plain[:, :, 1:] * plain[:, :, :-1]) / plain.var()) < 0.02


class Wall(Corridor):
    """A slanted wall with a board before it, at the very size of the depth maps."""

    @property
    def info(self) -> SequenceInfo:
        info = super().info
        K = resize_intrinsics(true_intrinsics(), SIZE, (126, WIDTH))
        return SequenceInfo("wall", (126, WIDTH), 20, K, "given", info.truth)

    def true_depth(self, frame: int) -> Map:
        inverse = np.full((126, WIDTH), 0.2, np.float32) + np.linspace(0, 0.1, WIDTH)
        inverse[40:80, 90:140] = 0.5
        return np.asarray(1 / inverse, np.float32)


def test_blur_makes_slopes_of_edges_and_leaves_planes() -> None:
    made = backbone(Wall(20), edge_blur_px=1.5)
    prediction = predict(made)
    errors = log_errors(made, prediction)
    at_edge = np.zeros((126, WIDTH), bool)
    at_edge[36:84, 86:144] = True
    at_edge[44:76, 94:136] = False
    inside = np.zeros(at_edge.shape, bool)
    inside[8:-8, 8:-8] = True
    assert np.abs(errors[:, inside & ~at_edge]).max() < 0.01
    row = prediction.depth[0, 60, 84:97] / np.median(truth(made, prediction))
    steps = np.diff(np.log(row))
    assert (steps < 1e-3).all()  # from the wall to the board, without a jump
    assert np.abs(steps).max() < 0.5 * abs(np.log(row[-1] / row[0]))
    at_border = prediction.confidence[:, 44:76, 88:92]
    assert at_border.mean() < 0.85 * prediction.confidence[:, inside & ~at_edge].mean()


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_blobs_cover_their_share_in_coherent_pieces(share: float) -> None:
    made = backbone(blob_share=share, blob_told=0.0)
    prediction = predict(made)
    errors = np.log(prediction.depth / truth(made, prediction))
    wrong = np.abs(errors - np.median(errors)) > 1e-3
    assert wrong.mean() == pytest.approx(share, rel=0.15)
    inside = wrong[:, :, 1:] & wrong[:, :, :-1]
    assert inside.sum() > 0.85 * wrong.sum()  # neighbours go wrong together
    assert 0.3 * 0.999 < np.exp(errors[wrong] - np.median(errors)).min()
    assert np.exp(errors[wrong] - np.median(errors)).max() < 3.34
    assert len(np.unique(np.round(errors[wrong], 3))) > 10


def test_more_blobs_than_fit_end() -> None:
    labels, factors = np.zeros((40, 60), np.uint8), [1.0]
    add_blobs(labels, factors, 1.0, np.random.default_rng(0))
    assert len(factors) <= 256
    assert (labels > 0).mean() > 0.9


def test_smooth_maps_have_variance_one_everywhere() -> None:
    grids = np.random.default_rng(0).standard_normal((4000, 4, 7), np.float32)
    variance = smooth_maps(grids, (20, 50)).var(axis=0)
    assert variance.min() > 0.88
    assert variance.max() < 1.12


# --- poses --------------------------------------------------------------------------------------


def pose_errors(made: SimulatedBackbone, first: int, num: int) -> NDArray[np.float64]:
    """Return (N, 4, 4) true_from_predicted cameras, in median depths."""
    prediction = predict(made, first, num)
    window = made._truth.window(prediction.frames)
    true = np.linalg.inv(window.world_from_cam[0]) @ window.world_from_cam
    true[:, :3, 3] /= window.median_m
    return np.asarray(np.linalg.inv(true) @ prediction.window_from_cam)


def test_pose_noise_has_its_size_in_rotation_and_position() -> None:
    made = backbone(pose_rotation_deg=0.5, pose_translation=0.02, width=56)
    errors = np.concatenate([pose_errors(made, first, 10) for first in range(0, 50, 5)])
    angles = np.degrees(np.linalg.norm(rotation_log(errors[:, :3, :3]), axis=1))
    shifts = np.linalg.norm(errors[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(0.5, rel=0.15)
    assert np.sqrt(np.mean(shifts**2)) == pytest.approx(0.02, rel=0.15)


def test_drift_grows_along_the_window_and_differs_between_windows() -> None:
    made = backbone(drift_rotation_deg=0.2, width=56)
    ends, middles = [], []
    for first in range(40):
        errors = rotation_log(pose_errors(made, first, 11)[:, :3, :3])
        middles.append(errors[5])
        ends.append(errors[10])
    angles = np.degrees(np.linalg.norm(ends, axis=1))
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(2.0, rel=0.3)  # ten steps of 0.2
    np.testing.assert_allclose(np.array(ends), 2 * np.array(middles), rtol=0.1, atol=2e-3)
    assert np.linalg.norm(np.mean(ends, axis=0)) < 0.4 * np.radians(2.0)  # no common direction


def test_slip_is_a_share_of_the_path() -> None:
    made = backbone(drift_translation=0.05, width=56)
    shares = []
    for first in range(40):
        prediction = predict(made, first, 11)
        window = made._truth.window(prediction.frames)
        centres = window.world_from_cam[:, :3, 3] / window.median_m
        path = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
        shares.append(np.linalg.norm(pose_errors(made, first, 11)[10, :3, 3]) / path)
    assert np.sqrt(np.mean(np.square(shares))) == pytest.approx(0.05, rel=0.3)


# --- windows, confidence, gaps ------------------------------------------------------------------

FLAWS: dict[str, dict[str, object]] = {
    "smooth": {"smooth_sigma": 0.1},
    "bands": {"layers": "bands", "layer_sigma": 0.1, "band_width": 0.2},
    "objects": {"layers": "objects", "layer_sigma": 0.1},
    "smooth noise": {"noise_smooth": 0.05},
    "iid noise": {"noise_iid": 0.05},
    "blobs": {"blob_share": 0.1},
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_what_persists_is_alike_in_two_windows_and_the_rest_is_not(flaw: str) -> None:
    """On the frames that two windows share, over some pairs of windows."""

    def likeness(persistence: float) -> float:
        made = backbone(persistence=persistence, width=126, **FLAWS[flaw])
        found = []
        for first in range(0, 40, 4):
            one, other = predict(made, first), predict(made, first + 5)
            pair = log_errors(made, one)[5:], log_errors(made, other)[:5]
            found.append(np.corrcoef(pair[0].ravel(), pair[1].ravel())[0, 1])
        return float(np.mean(found))

    assert abs(likeness(0.0)) < 0.4
    assert likeness(1.0) > 0.85


@pytest.mark.parametrize("first", [0, 9])
def test_doubtful_pixels_are_wrong_more_often(street: Dataset, first: int) -> None:
    settings: dict[str, object] = {
        "noise_smooth": 0.03,
        "noise_iid": 0.01,
        "edge_blur_px": 1.5,
        "blob_share": 0.05,
    }

    def correlation(told: float) -> float:
        made = backbone(street, confidence_told=told, blob_told=told, width=518, **settings)
        prediction = predict(made, first)
        errors, known = np.abs(log_errors(made, prediction)), prediction.confidence > 0
        return float(spearmanr(prediction.confidence[known], errors[known]).statistic)

    assert correlation(1.0) < -0.3
    assert correlation(1.0) < correlation(0.5) - 0.03
    assert abs(correlation(0.0)) < 0.1


def test_blobs_lower_confidence_as_far_as_they_are_told() -> None:
    def ratio(told: float) -> float:
        made = backbone(blob_share=0.1, blob_told=told)
        prediction = predict(made)
        errors = log_errors(made, prediction)
        is_blob = np.abs(errors) > 1e-3
        return float(prediction.confidence[is_blob].mean() / prediction.confidence[~is_blob].mean())

    assert ratio(0.0) == pytest.approx(1.0, abs=0.1)
    assert ratio(0.5) == pytest.approx(0.5, abs=0.06)
    assert ratio(1.0) == 0.0


class Gaps(Corridor):
    """A corridor whose truth has holes: pixels, a frame without depth, frames without pose."""

    @property
    def info(self) -> SequenceInfo:
        info = super().info
        assert info.truth is not None
        keep = ~np.isin(info.truth.frames, [0, 4, 5])
        truth = Trajectory(
            info.truth.frames[keep], info.truth.times_s[keep], info.truth.world_from_cam[keep]
        )
        return SequenceInfo(
            "gaps", info.size, info.num_frames, info.intrinsics, info.intrinsics_source, truth
        )

    def true_depth(self, frame: int) -> Map | None:
        depth = view(frame)[1]
        depth[:30] = np.nan
        return None if frame in (2, 3, 20, 21, 22) else depth


def test_unknown_depth_stays_unknown_and_missing_poses_come_from_neighbours() -> None:
    made = backbone(Gaps(40), **{**DEFAULTS, "width": WIDTH})
    prediction = predict(made)
    size = made.image_size(SIZE)
    unknown = np.isnan(prediction.depth)
    assert unknown[[2, 3]].all()
    assert unknown[:, : size[0] * 30 // 72 - 1].all()
    assert not unknown[4, size[0] * 30 // 72 + 1 :].any()
    assert not prediction.confidence[unknown].any()
    assert (prediction.confidence[~unknown] > 0).all()
    assert "3 frames have no true pose: taken from their neighbours" in prediction.warnings
    assert "2 frames have no true depth: left unknown" in prediction.warnings
    exact = predict(backbone(Gaps(40)))
    whole = predict(backbone())
    pair = [Sim3.from_matrix(p.window_from_cam[1]).inverse() for p in (exact, whole)]
    gaps = [s.apply_poses(p.window_from_cam) for s, p in zip(pair, (exact, whole), strict=True)]
    lengths = [np.linalg.norm(poses[9, :3, 3]) for poses in gaps]
    shift = gaps[0][:, :3, 3] / lengths[0] - gaps[1][:, :3, 3] / lengths[1]
    assert np.abs(shift).max() < 0.02


def test_a_window_without_any_true_depth_fails_with_a_reason() -> None:
    prediction = predict(backbone(Gaps(40)), 20, 3)
    assert prediction.status is WindowStatus.FAILED
    assert np.isnan(prediction.depth).all()
    assert "3 frames have no true depth: left unknown" in prediction.warnings


def test_hundreds_of_frames_a_second_are_within_reach(street: Dataset) -> None:
    """At 518 wide, in CPU time: 10 ms a frame are 200 frames/s on two cores, here with room."""
    made = backbone(street, **{**DEFAULTS, "width": 518})
    predict(made, 0, 20)
    start = time.process_time()
    predict(made, 0, 20)
    assert (time.process_time() - start) / 20 < 0.02


# --- refusals, and a whole run ------------------------------------------------------------------


class NoDepth(Corridor):
    def true_depth(self, frame: int) -> Map | None:
        return None


@pytest.mark.parametrize(
    ("dataset", "lacks"),
    [
        (Corridor(20, with_truth=False), "ground-truth poses, which corridor lacks"),
        (Corridor(20, with_intrinsics=False), "known intrinsics, which corridor lacks"),
        (NoDepth(20), "ground-truth depth, which corridor lacks"),
    ],
)
def test_a_data_set_without_truth_is_refused_in_one_line(dataset: Corridor, lacks: str) -> None:
    with pytest.raises(ConfigError, match=f"^backbone.name: simulated needs {lacks}") as caught:
        backbone(dataset)
    assert "use another backbone" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_a_data_set_it_is_refused_too() -> None:
    config = load_config(assignments=["backbone.name=simulated"]).backbone
    with pytest.raises(ConfigError, match="simulated needs ground-truth poses, which this input"):
        make_backbone(config)


def run_report(folder: Path, *settings: str) -> dict[str, object]:
    names = ["backbone.name=simulated", f"backbone.simulated.width={WIDTH}", "windows.size=8"]
    names += ["windows.overlap=3", "windows.min_parallax_px=0.2", *settings]
    return Pipeline(Corridor(30), load_config(assignments=names), folder).run().report


def test_a_whole_run_maps_the_corridor_and_says_what_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_pictures_out(monkeypatch)
    exact = run_report(
        tmp_path / "exact",
        *[f"backbone.simulated.{name}={value}" for name, value in NOTHING.items()],
        "backbone.simulated.scale_sigma=0.5",
    )
    wrong = run_report(tmp_path / "wrong")
    assert exact["trajectory"]["ate_sim3_m"]["rmse"] < 5e-3  # type: ignore[index]
    assert exact["depth"]["by_trajectory_scale"]["abs_rel"] < 2e-3  # type: ignore[index]
    assert 5e-3 < wrong["trajectory"]["ate_sim3_m"]["rmse"] < 1.0  # type: ignore[index]
    assert 0.02 < wrong["depth"]["by_median_ratio"]["abs_rel"] < 0.2  # type: ignore[index]
    said = [warning for warning in exact["warnings"] if SIMULATED in warning]  # type: ignore[attr-defined]
    assert len(said) == 1
