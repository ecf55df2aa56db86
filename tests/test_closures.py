"""Closures: the place of two windows that saw one place, and what is no closure."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from corridor import Corridor
from numpy.typing import NDArray
from rendered import RenderedDrive, seen_from

from laser_slam.backbones import make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.closures import (
    CandidateEnds,
    ClosureRecord,
    End,
    Judged,
    Matcher,
    Measurement,
    PairMatches,
    Tools,
    judge,
    make_matcher,
    match_ends,
    measure_by_matches,
    measure_by_window,
    read_closures,
    write_closures,
)
from laser_slam.closures.alignment import align_clouds, displacement
from laser_slam.closures.clouds import compare, make_cloud
from laser_slam.closures.loop_window import _composed
from laser_slam.closures.measurement import error_between, fuse, moved_by
from laser_slam.config import Config, load_config
from laser_slam.errors import DegenerateGeometryError, RunFolderError
from laser_slam.places import Verification
from laser_slam.sim3 import Array, Sim3, rotation_exp, umeyama
from laser_slam.types import Image, Prediction, Registration, SequenceInfo, Trajectory, WindowStatus

SEEDS = range(8)
CONFIG = load_config()
FEATURES = make_matcher(CONFIG.places.verification)
MATCHES: dict[bytes, Verification] = {}
FRAMES_A, FRAMES_B = np.arange(0, 20, 2), np.arange(3, 23, 2)  # no frame in common
MATCHED_A, MATCHED_B = 4, 3  # frames 8 and 9
EXACT = {
    name: 0.0
    for name in (
        "scale_sigma smooth_sigma layer_sigma noise_smooth noise_iid edge_blur_px blob_share "
        "pose_rotation_deg pose_translation drift_rotation_deg drift_translation persistence"
    ).split()
}
LAYERED = {**EXACT, "layer_sigma": 0.08, "smooth_sigma": 0.03, "noise_smooth": 0.02}
NETWORK: dict[str, float] = {}  # the simulated backbone's own errors


def MATCHER(first: Image, second: Image, intrinsics: Array) -> Verification:  # noqa: N802
    """Match real features, each pair of images once for all tests."""
    key = first.tobytes() + second.tobytes()
    if key not in MATCHES:
        MATCHES[key] = FEATURES(first, second, intrinsics)
    return MATCHES[key]


class Scene:
    """The rendered street as seen by simulated networks: each window with errors of its own."""

    def __init__(self, drive: RenderedDrive) -> None:
        self.drive = drive
        num, frames = len(drive.images), np.arange(len(drive.images))

        class Street(Corridor):
            @property
            def info(self) -> SequenceInfo:
                size = drive.depths.shape[1], drive.depths.shape[2]
                poses = Trajectory(frames, frames / 10, drive.world_from_cam)
                return SequenceInfo("street", size, num, drive.intrinsics, "given", poses)

            def true_depth(self, frame: int) -> NDArray[np.float32] | None:
                return np.array(drive.depths[frame])

        self._street = Street(num)
        self._ends: dict[object, tuple[End, End]] = {}

    def backbone(self, seed: int, errors: dict[str, float]) -> Backbone:
        settings = {"width": 378, "seed": seed, **errors}
        names = [f"backbone.simulated.{name}={value}" for name, value in settings.items()]
        config = load_config(assignments=["backbone.name=simulated", *names])
        return make_backbone(config.backbone, self._street.info, self._street.true_depth)

    def ends(self, seed: int, errors: dict[str, float]) -> tuple[End, End]:
        """Predict two windows; the second lies anywhere, in a unit of its own."""
        key = seed, tuple(errors.items())
        if key not in self._ends:
            self._ends[key] = self._predict(seed, errors)
        return self._ends[key]

    def _predict(self, seed: int, errors: dict[str, float]) -> tuple[End, End]:
        rng = np.random.default_rng(seed)
        first = self.backbone(seed, errors).predict([], FRAMES_A, None)
        second = self.backbone(seed + 1000, errors).predict([], FRAMES_B, None)
        turn = rotation_exp(rng.normal(size=3))
        anywhere = Sim3(float(np.exp(0.5 * rng.normal())), turn, rng.normal(size=3))
        return (
            End(3, first, self.colors(first), MATCHED_A),
            End(40, moved(second, anywhere), self.colors(second), MATCHED_B),
        )

    def colors(self, prediction: Prediction) -> Image:
        size = prediction.depth.shape[2], prediction.depth.shape[1]
        images = [self.drive.images[frame] for frame in prediction.frames]
        return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])

    def world_from_window(self, end: End) -> Sim3:
        """Fit a window to the truth: scale by its depth, the rest by all its cameras."""
        prediction = end.prediction
        height, width = prediction.depth.shape[1:]
        rows, cols = self.drive.depths.shape[1], self.drive.depths.shape[2]
        y = np.rint((np.arange(height) + 0.5) / height * rows - 0.5).astype(int)
        x = np.rint((np.arange(width) + 0.5) / width * cols - 0.5).astype(int)
        true = self.drive.depths[prediction.frames][:, y][:, :, x]
        scale = float(np.exp(np.nanmedian(np.log(true / prediction.depth))))
        poses = prediction.window_from_cam.copy()
        poses[:, :3, 3] *= scale
        axes = float(np.nanmedian(true)) * np.concatenate([np.eye(3), -np.eye(3)])
        source, target = (
            (each[:, None, :3, 3] + axes @ np.swapaxes(each[:, :3, :3], 1, 2)).reshape(-1, 3)
            for each in (poses, self.drive.world_from_cam[prediction.frames])
        )
        rigid = umeyama(source, target, with_scale=False)
        return Sim3(scale, rigid.rotation, rigid.translation)

    def a_from_b(self, a: End, b: End) -> Sim3:
        return self.world_from_window(a).inverse() @ self.world_from_window(b)

    def pairs(self, a: End, b: End, seed: int, wrong: float = 0.0) -> list[PairMatches]:
        """Match the ends by the truth, pixels 0.7 off, some matches anywhere."""
        steps = (0, 1, 2, -1, -2)
        return [self._pair(a, b, step, (seed, wrong)) for step in steps]

    def _pair(self, a: End, b: End, step: int, draw: tuple[int, float]) -> PairMatches:
        rng = np.random.default_rng([draw[0], step + 10])
        i, j = a.matched + step, b.matched + step
        rows, cols = self.drive.depths.shape[1], self.drive.depths.shape[2]
        first = np.rint(rng.uniform([12, 12], [cols - 13, rows - 13], (500, 2)))
        frames = int(a.prediction.frames[i]), int(b.prediction.frames[j])
        second = seen_from(self.drive, *frames, first)
        visible = np.isfinite(second).all(axis=1)
        first, second = first[visible][:150], second[visible][:150]
        is_wrong = rng.random(len(first)) < draw[1]
        second[is_wrong] = rng.uniform([12, 12], [cols - 13, rows - 13], (is_wrong.sum(), 2))
        factor = a.prediction.depth.shape[2] / cols
        pixels = [(each + 0.5) * factor - 0.5 for each in (first, second)]
        noisy = [each + rng.normal(0, 0.7, each.shape) for each in pixels]
        return PairMatches(i, j, noisy[0], noisy[1])


@pytest.fixture(scope="module")
def scene(short_drive: RenderedDrive) -> Scene:
    return Scene(short_drive)


@pytest.fixture(scope="module")
def network_ends(scene: Scene) -> tuple[End, End]:
    return scene.ends(0, NETWORK)


def moved(prediction: Prediction, other_from_window: Sim3) -> Prediction:
    """Give a window another frame and unit."""
    return replace(
        prediction,
        depth=prediction.depth * np.float32(other_from_window.scale),
        window_from_cam=other_from_window.apply_poses(prediction.window_from_cam),
    )


def camera_error(found: Sim3, true: Sim3, a: End) -> tuple[float, float, float]:
    """Return how far a's matched camera is off, in median depths, degrees and log-scale."""
    center = a.prediction.window_from_cam[a.matched, :3, 3]
    move = found.apply(true.inverse().apply(center)) - center
    error = error_between(found, true)
    turn = float(np.degrees(np.linalg.norm(error[:3])))
    return float(np.linalg.norm(move)) / a.median_depth, turn, abs(float(error[6]))


def settings(**closures: object) -> Config:
    return load_config(assignments=[f"closures.{name}={value}" for name, value in closures.items()])


def judged(
    ends: tuple[End, End], matcher: Matcher = MATCHER, config: Config = CONFIG, scale: float = 1.0
) -> Judged:
    """Judge what the chain has right, or wrong by a factor."""
    _, guess = match_ends(*ends, MATCHER, CONFIG.closures)
    chain = measure_by_matches(*ends, guess, CONFIG.closures).a_from_b.scale if guess else 1.0
    return judge(CandidateEnds(*ends, 0.8, scale * chain), Tools(matcher), config)


# --- matches ------------------------------------------------------------------------------------


def test_exact_windows_are_placed_to_the_noise_of_the_pixels(scene: Scene) -> None:
    a, b = scene.ends(0, EXACT)
    found = measure_by_matches(a, b, scene.pairs(a, b, 0), CONFIG.closures)
    move, turn_deg, growth = camera_error(found.a_from_b, scene.a_from_b(a, b), a)
    assert (move, turn_deg, growth) < (2e-3, 0.1, 2e-3)
    assert max(move, growth) < 2e-3
    assert turn_deg < 0.1
    assert found.inliers > 0.98 * found.total


@pytest.mark.parametrize(
    ("errors", "wrong", "limits"),
    [
        (LAYERED, 0.0, (0.01, 0.2, 0.04)),
        (LAYERED, 0.3, (0.015, 0.3, 0.05)),
        (NETWORK, 0.3, (0.02, 0.5, 0.05)),
    ],
    ids=["layers", "layers and 30 % wrong", "network and 30 % wrong"],
)
def test_distorted_windows_are_placed_within_the_sigmas(
    scene: Scene, errors: dict[str, float], wrong: float, limits: Array
) -> None:
    misfits, cameras = [], []
    for seed in SEEDS:
        a, b = scene.ends(seed, errors)
        found = measure_by_matches(a, b, scene.pairs(a, b, seed, wrong), CONFIG.closures)
        true = scene.a_from_b(a, b)
        misfits.append(float(np.mean((error_between(found.a_from_b, true) / found.sigmas) ** 2)))
        cameras.append(camera_error(found.a_from_b, true, a))
    assert 0.05 < np.mean(misfits) < 2  # 1 where sigmas are exact, less where poses err less
    assert max(misfits) < 6
    assert (np.median(cameras, axis=0) < limits).all()


def test_the_full_covariance_holds_at_the_cameras_too(scene: Scene) -> None:
    """Far from window b's origin turn and growth move things; the covariance knows."""
    misfits = []
    for seed in SEEDS:
        a, b = scene.ends(seed, NETWORK)
        found = measure_by_matches(a, b, scene.pairs(a, b, seed), CONFIG.closures)
        error = error_between(found.a_from_b, scene.a_from_b(a, b))
        misfits.append(error @ np.linalg.solve(found.covariance, error) / 7)
    assert 0.1 < np.mean(misfits) < 3


def test_the_answer_does_not_depend_on_units_or_on_which_end_comes_first(scene: Scene) -> None:
    a, b = scene.ends(1, NETWORK)
    pairs = scene.pairs(a, b, 1, wrong=0.3)
    found = measure_by_matches(a, b, pairs, CONFIG.closures)
    for factor_a, factor_b in ((0.01, 100.0), (100.0, 1.0)):
        other_a = replace(a, prediction=moved(a.prediction, Sim3(factor_a)))
        other_b = replace(b, prediction=moved(b.prediction, Sim3(factor_b)))
        other = measure_by_matches(other_a, other_b, pairs, CONFIG.closures)
        expected = Sim3(factor_a) @ found.a_from_b @ Sim3(1 / factor_b)
        assert error_between(other.a_from_b, expected) == pytest.approx(0, abs=1e-3 * factor_a)
        assert other.inliers == found.inliers
        np.testing.assert_allclose(other.sigmas[[0, 6]], found.sigmas[[0, 6]], rtol=0.02)
    swapped = [PairMatches(p.in_b, p.in_a, p.pixels_b, p.pixels_a) for p in pairs]
    back = measure_by_matches(b, a, swapped, CONFIG.closures)
    move, turn_deg, growth = camera_error(back.a_from_b.inverse(), found.a_from_b, a)
    assert max(move, growth) < 0.01
    assert turn_deg < 0.1


def test_more_pairs_of_frames_make_the_measurement_surer_and_better(scene: Scene) -> None:
    errors: dict[int, list[float]] = {1: [], 5: []}
    for seed in SEEDS:
        a, b = scene.ends(seed, NETWORK)
        true, pairs = scene.a_from_b(a, b), scene.pairs(a, b, seed)
        sigmas = []
        for num, found_errors in errors.items():
            found = measure_by_matches(a, b, pairs[:num], CONFIG.closures)
            found_errors.append(sum(camera_error(found.a_from_b, true, a)[::2]))
            sigmas.append(found.sigmas[6])
        assert sigmas[1] < sigmas[0]
    assert np.mean(errors[5]) < np.mean(errors[1])


def test_random_matches_measure_nothing(scene: Scene) -> None:
    a, b = scene.ends(0, NETWORK)
    for seed in SEEDS:
        pairs = scene.pairs(a, b, seed, wrong=1.0)
        with pytest.raises(DegenerateGeometryError, match=r"matches fit one similarity|agree on"):
            measure_by_matches(a, b, pairs, CONFIG.closures)


# --- the backbone's window of both ends ---------------------------------------------------------


def test_a_window_of_both_ends_measures_the_closure_within_its_sigmas(scene: Scene) -> None:
    misfits, cameras = [], []
    for seed in SEEDS:
        a, b = scene.ends(seed, NETWORK)
        found = measure_by_window(a, b, scene.backbone(seed + 2000, NETWORK), None, CONFIG)
        true = scene.a_from_b(a, b)
        misfits.append(float(np.mean((error_between(found.a_from_b, true) / found.sigmas) ** 2)))
        cameras.append(camera_error(found.a_from_b, true, a))
    # On the safe side: these windows see the same surfaces, and hardly bend.
    assert 0.03 < np.mean(misfits) < 1
    assert (np.median(cameras, axis=0) < (0.02, 0.5, 0.05)).all()


def test_the_sigmas_of_a_chain_through_a_third_window_are_those_of_its_links() -> None:
    """First order against random draws: both links err as their sigmas say."""
    rng = np.random.default_rng(0)
    links = [Sim3(2.0, rotation_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2)]
    sigmas = [1e-3 * rng.uniform(0.5, 2, 7) for _ in range(2)]
    a_from_b = links[0] @ links[1].inverse()
    errors = []
    for _ in range(4000):
        off = []
        for link, sigma in zip(links, sigmas, strict=True):
            error = sigma * rng.normal(size=7)
            turned = rotation_exp(error[:3]) @ link.rotation
            growth = float(np.exp(error[6]))
            off.append(Sim3(link.scale * growth, turned, link.translation + error[3:6]))
        errors.append(error_between(off[0] @ off[1].inverse(), a_from_b))
    sides = [Registration(*args, 1, 0.0) for args in zip(links, sigmas, strict=True)]
    expected = _composed(a_from_b, links[0], sides)
    drawn = np.cov(np.array(errors).T)
    scale = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(
        drawn / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.1
    )


def test_a_window_that_fits_neither_end_measures_nothing(scene: Scene) -> None:
    a, b = scene.ends(0, NETWORK)
    strict = settings(max_residual=0.001)
    with pytest.raises(DegenerateGeometryError, match="differ from window 3 by"):
        measure_by_window(a, b, scene.backbone(2000, NETWORK), None, strict)


class Blind:
    """A backbone that takes any frames and sees nothing."""

    remembers = False

    def __init__(self, inner: Backbone, *, sees_far_frames: bool) -> None:
        self._inner = inner
        self.image_size, self.identity = inner.image_size, inner.identity
        self.calibrate = inner.calibrate
        self.sees_far_frames = sees_far_frames

    def predict(
        self, images: Sequence[Image], frames: NDArray[np.int64], intrinsics: Array | None
    ) -> Prediction:
        found = self._inner.predict(images, frames, intrinsics)
        unknown = np.full_like(found.depth, np.nan), np.zeros_like(found.depth)
        return replace(found, depth=unknown[0], confidence=unknown[1], status=WindowStatus.FAILED)


def test_a_backbone_that_must_follow_frames_is_not_asked(scene: Scene) -> None:
    a, b = scene.ends(0, NETWORK)
    inner = scene.backbone(2000, NETWORK)
    candidate = CandidateEnds(a, b, 0.8, scene.a_from_b(a, b).scale)
    verdicts = {}
    for sees_far in (False, True):
        tools = Tools(MATCHER, Blind(inner, sees_far_frames=sees_far))
        verdicts[sees_far] = judge(candidate, tools, CONFIG).record.verdict
    assert verdicts[False] == "accepted"
    assert verdicts[True] == "the window of both ends is failed"


def test_two_measurements_that_agree_are_fused_and_others_refused(scene: Scene) -> None:
    a, b = scene.ends(0, NETWORK)
    true = scene.a_from_b(a, b)
    candidate = CandidateEnds(a, b, 0.8, true.scale)
    tools = Tools(MATCHER, scene.backbone(2000, NETWORK))
    found = judge(candidate, tools, CONFIG)
    assert found.record.is_accepted
    assert found.record.source == "matches, loop window"
    assert found.record.disagreement is not None
    limit = found.record.disagreement / 2
    refused = judge(candidate, tools, settings(max_disagreement=limit))
    assert "sigmas apart" in refused.record.verdict


def test_a_fused_measurement_follows_the_surer_and_is_no_surer() -> None:
    rng = np.random.default_rng(0)
    sigmas = np.array([[1, 1, 1, 1, 1, 1, 1], [10.0] * 7]) * 1e-3
    first, second = (
        Measurement(
            Sim3(1 + 0.01 * i, rotation_exp(0.01 * rng.normal(size=3)), 0.01 * rng.normal(size=3)),
            np.diag(sigma**2),
            10,
            20,
            0.1 * i,
            name,
        )
        for i, (sigma, name) in enumerate(zip(sigmas, "ab", strict=True))
    )
    mean = fuse(first, second)
    gap = error_between(second.a_from_b, first.a_from_b)
    np.testing.assert_allclose(error_between(mean.a_from_b, first.a_from_b), gap / 101, atol=1e-6)
    np.testing.assert_allclose(mean.sigmas, np.sqrt(2 / (1 + 0.01)) * first.sigmas)
    assert mean.residual == 0.1


# --- clouds -------------------------------------------------------------------------------------


def about_camera(
    a: End, turn_deg: Sequence[float], move: Sequence[float], scale: float = 1
) -> Sim3:
    """Return a motion in camera axes about a's matched camera, in median depths."""
    a_from_cam = Sim3.from_matrix(a.prediction.window_from_cam[a.matched])
    off = Sim3(scale, rotation_exp(np.radians(turn_deg)), a.median_depth * np.array(move))
    return a_from_cam @ off @ a_from_cam.inverse()


@pytest.mark.parametrize(
    ("turn_deg", "move", "scale"),
    [
        ((0, 0, 0), (0, 0, 0.5), 1),
        ((0, 0, 0), (0.5, 0, 0), 1),
        ((0, 0, 0), (0, -0.3, 0), 1),
        ((0, 30, 0), (0, 0, 0), 1),
        ((0, 180, 0), (0, 0, 0), 1),
        ((0, 0, 20), (0, 0, 0), 1),
        ((0, 0, 0), (0, 0, 0), 1.5),
        ((0, 0, 0), (0, 0, 0), 0.6),
    ],
)
def test_clouds_that_are_laid_wrong_lie_worse(
    scene: Scene, network_ends: tuple[End, End], turn_deg: Array, move: Array, scale: float
) -> None:
    a, b = network_ends
    clouds = make_cloud(a, CONFIG.closures), make_cloud(b, CONFIG.closures)
    right = scene.a_from_b(a, b)
    good = compare(*clouds, right, CONFIG.closures)
    bad = compare(*clouds, about_camera(a, turn_deg, move, scale) @ right, CONFIG.closures)
    assert good.overlap > CONFIG.closures.min_overlap + 0.1
    assert good.covisible > 2 * CONFIG.closures.min_covisible
    assert bad.overlap * bad.covisible < 0.8 * good.overlap * good.covisible


def measurement(a_from_b: Sim3, sigma: float, pivot: Array) -> Measurement:
    """Return one that is sure to ``sigma`` at a pivot."""
    carry = moved_by(a_from_b.translation, pivot)
    covariance = carry @ (sigma**2 * np.eye(7)) @ carry.T
    return Measurement(a_from_b, covariance, 100, 100, 0.01, "matches")


def test_registration_of_the_clouds_mends_what_the_measurement_leaves_open(scene: Scene) -> None:
    a, b = scene.ends(0, EXACT)
    clouds = make_cloud(a, CONFIG.closures), make_cloud(b, CONFIG.closures)
    right = scene.a_from_b(a, b)
    pivot = a.prediction.window_from_cam[a.matched, :3, 3]
    off = about_camera(a, (0.5, 0.5, 0), (0.02, 0.01, 0)) @ right
    unsure = measurement(off, 0.05 * a.median_depth, pivot)
    mended = align_clouds(*clouds, unsure, pivot, CONFIG.closures) @ off
    before, after = camera_error(off, right, a), camera_error(mended, right, a)
    assert after[0] < 0.5 * before[0]
    assert after[1] < 0.5 * before[1]
    assert mended.scale == pytest.approx(off.scale)
    sure = measurement(off, 1e-5 * a.median_depth, pivot)
    still = align_clouds(*clouds, sure, pivot, CONFIG.closures)
    move, turn_deg = displacement(still, a.prediction.window_from_cam[:, :3, 3], a.median_depth)
    assert move < 1e-3
    assert turn_deg < 0.01


# --- judgement ----------------------------------------------------------------------------------


def test_a_closure_of_real_features_is_accepted_with_all_its_numbers(scene: Scene) -> None:
    a, b = scene.ends(0, NETWORK)
    true = scene.a_from_b(a, b)
    found = judge(CandidateEnds(a, b, 0.8, true.scale), Tools(MATCHER), CONFIG)
    record = found.record
    assert record.verdict == "accepted"
    assert found.measurement is not None
    assert (record.window_a, record.window_b, record.frame_a, record.frame_b) == (3, 40, 8, 9)
    unmeasured = {name for name, value in vars(record).items() if value is None}
    assert unmeasured == {"disagreement"}
    move, turn_deg, growth = camera_error(found.measurement.a_from_b, true, a)
    assert max(move, growth) < 0.05
    assert turn_deg < 0.6


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_the_verdict_does_not_depend_on_units(network_ends: tuple[End, End], factor: float) -> None:
    a, b = network_ends
    expected = judged((a, b)).record
    other = judged((replace(a, prediction=moved(a.prediction, Sim3(factor))), b)).record
    assert other.verdict == expected.verdict == "accepted"
    assert other.inliers == expected.inliers
    assert other.overlap == pytest.approx(expected.overlap, abs=0.02)


@pytest.mark.parametrize(
    ("changed", "scale", "reason"),
    [
        ({}, 30.0, "where the chain says"),
        ({}, 1 / 30, "where the chain says"),
        ({"max_heading_deg": 1e-3}, 1.0, "degrees apart, at most"),
        ({"min_inliers": 100_000}, 1.0, "matches have depth at both ends, need 100000"),
        ({"max_residual": 1e-4}, 1.0, "depths differ by"),
        ({"min_covisible": 1.0}, 1.0, "of each other's surfaces, need 1.00"),
        ({"min_overlap": 1.0}, 1.0, "the clouds overlap by"),
        ({"max_move": 1e-9}, 1.0, "registration of the clouds moves them by"),
        ({"max_turn_deg": 1e-9}, 1.0, "registration of the clouds moves them by"),
    ],
)
def test_each_check_rejects_with_its_reason(
    network_ends: tuple[End, End], changed: dict[str, float], scale: float, reason: str
) -> None:
    found = judged(network_ends, config=settings(**changed), scale=scale)
    assert reason in found.record.verdict
    assert found.measurement is None
    assert judged(network_ends).record.is_accepted


def test_the_scale_may_be_as_far_off_as_a_long_chain_drifts(network_ends: tuple[End, End]) -> None:
    a, b = network_ends
    assert not judged((a, replace(b, window=4)), scale=3.0).record.is_accepted
    assert judged((a, replace(b, window=200)), scale=3.0).record.is_accepted


def unknown(end: End, where: NDArray[np.bool_]) -> End:
    depth, confidence = end.prediction.depth.copy(), end.prediction.confidence.copy()
    depth[where], confidence[where] = np.nan, 0
    return replace(end, prediction=replace(end.prediction, depth=depth, confidence=confidence))


def same_facade(a: End, b: End) -> tuple[End, End]:
    """Keep what was matched at the left, and make the rest of b another place."""
    depth = b.prediction.depth.copy()
    depth[:, :, depth.shape[2] // 2 :] *= 2.5
    return a, replace(b, prediction=replace(b.prediction, depth=depth))


def changed_matches(change: Callable[[Array, Array], tuple[Array, Array]]) -> Matcher:
    """Match real features, and change the pixels; rejected is then nothing."""

    def match(first: Image, second: Image, intrinsics: Array) -> Verification:
        found = MATCHER(first, second, intrinsics)
        a, b = change(found.first_pixels, found.second_pixels)
        return replace(found, first_pixels=a, second_pixels=b, rejected=None)

    return match


def left_half(a: Array, b: Array) -> tuple[Array, Array]:
    is_left = (a[:, 0] < 184) & (b[:, 0] < 184)  # of 378
    return a[is_left], b[is_left]


def anywhere(a: Array, b: Array) -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    return rng.uniform(0, (377, 111), (200, 2)), rng.uniform(0, (377, 111), (200, 2))


def mirrored(a: Array, b: Array) -> tuple[Array, Array]:
    return a, np.stack([377 - b[:, 0], b[:, 1]], axis=1)


ONE_POINT = changed_matches(lambda a, b: (a * 0 + 50, b * 0 + 60))
ONE_POINT_IN_B = changed_matches(lambda a, b: (a, b * 0 + 60))
OUTSIDE = changed_matches(lambda a, b: (a + 1000, b))
MIRRORED = changed_matches(mirrored)
LEFT_MATCHES = changed_matches(left_half)
RANDOM_MATCHES = changed_matches(anywhere)
FEW_MATCHES = changed_matches(lambda a, b: (a[:3], b[:3]))
NO_MATCHES = changed_matches(lambda a, b: (a[:0], b[:0]))


@pytest.mark.parametrize(
    ("spoil", "matcher", "reason"),
    [
        (lambda end: end, NO_MATCHES, "the images have no matches"),
        (lambda end: end, RANDOM_MATCHES, "fit one similarity|agree on a pose"),
        (lambda end: end, ONE_POINT, "no pair of images has 8 matches with depth that agree"),
        (lambda end: end, ONE_POINT_IN_B, "no pair of images has 8 matches with depth that agree"),
        (lambda end: end, OUTSIDE, "matches have depth at both ends, need 30"),
        (lambda end: end, MIRRORED, "matches fit one similarity"),
        (lambda end: end, FEW_MATCHES, "matches have depth at both ends, need 30"),
        (lambda end: unknown(end, np.isfinite(end.prediction.depth)), MATCHER, "no depth"),
        (
            lambda end: replace(
                end, prediction=replace(end.prediction, status=WindowStatus.STATIC)
            ),
            MATCHER,
            "window 40 has no depth",
        ),
        (lambda end: replace(end, colors=end.colors * 0), MATCHER, "the images do not match"),
    ],
    ids="none random point point-in-b outside mirrored few unknown static black".split(),
)
def test_bad_input_is_a_verdict(
    network_ends: tuple[End, End], spoil: Callable[[End], End], matcher: Matcher, reason: str
) -> None:
    a, b = network_ends
    found = judge(CandidateEnds(a, spoil(b), 0.8, 1.0), Tools(matcher), CONFIG)
    assert found.measurement is None
    assert any(part in found.record.verdict for part in reason.split("|"))


def test_depth_nowhere_near_the_matches_is_a_verdict(network_ends: tuple[End, End]) -> None:
    a, b = network_ends
    left = np.broadcast_to(np.arange(b.prediction.depth.shape[2]) < 195, b.prediction.depth.shape)
    found = judge(CandidateEnds(a, unknown(b, left), 0.8, 1.0), Tools(LEFT_MATCHES), CONFIG)
    assert "0 of" in found.record.verdict
    assert "have depth at both ends" in found.record.verdict


def test_the_matched_frame_may_be_the_first_or_last_of_its_window(
    network_ends: tuple[End, End],
) -> None:
    a, b = network_ends
    for in_a, in_b in ((0, 0), (9, 9), (9, 5)):  # neighbours on one side only
        ends = replace(a, matched=in_a), replace(b, matched=in_b)
        record = judged(ends).record
        assert record.is_accepted
        assert record.image_pairs == 3


# --- records ------------------------------------------------------------------------------------


def test_records_survive_their_file(network_ends: tuple[End, End], tmp_path: Path) -> None:
    path = tmp_path / "closures.json"
    records = [
        judged(network_ends).record,
        judge(CandidateEnds(*network_ends, 0.1, 1.0), Tools(NO_MATCHES), CONFIG).record,
        ClosureRecord(0, 1, 2, 3, 0.5, "because"),
    ]
    for written in (records, []):
        write_closures(path, written)
        assert read_closures(path) == written
    assert [path.name] == [file.name for file in tmp_path.iterdir()]


@pytest.mark.parametrize("content", ["", "{", "[1]", '[{"window_a": 1}]'])
def test_a_damaged_file_of_records_says_so(tmp_path: Path, content: str) -> None:
    path = tmp_path / "closures.json"
    path.write_text(content)
    with pytest.raises(RunFolderError, match=r"cannot read closures .*closures\.json"):
        read_closures(path)
    with pytest.raises(RunFolderError, match="cannot write"):
        write_closures(tmp_path / "missing" / "closures.json", [])
