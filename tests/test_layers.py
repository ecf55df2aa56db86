"""Layer-wise scale alignment as a whole, on scenes whose every layer and scale is known."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ablate_street import measure
from boards import Boards, Window
from corridor import SIZE as CORRIDOR
from corridor import true_prediction
from numpy.typing import NDArray
from street import CASES, make_pair

from laser_slam.camera import unproject
from laser_slam.config import Config, LayersConfig, SegmentationConfig, load_config
from laser_slam.layers import (
    LayerCounts,
    align_layers,
    apply_layers,
    first_layers,
    make_segmenter,
)
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.slam import Slam
from laser_slam.types import Layers, Prediction, WindowStatus

Array = NDArray[np.float64]
NUM, OVERLAP = 6, 3  # frames
MANY = 1e9  # windows that are as good as the truth


@pytest.fixture(autouse=True)
def no_warning() -> Iterator[None]:
    """Nothing here may divide by zero or compare with NaN on the way."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def settings(block: int = 1, **changes: Any) -> LayersConfig:
    return LayersConfig(segmentation=SegmentationConfig(downscale=block), **changes)


def plain(block: int = 1, **changes: Any) -> LayersConfig:
    """Take each layer's scale as measured, and the window before for the truth."""
    chosen = {"memory": 0, "shrink": False, "feather": 0.0, "tau_intra": 0.3, **changes}
    return settings(block, **chosen)


def known(layers: Layers, witnesses: float = MANY) -> Layers:
    """Let many windows stand behind layers."""
    return replace(layers, witnesses=np.full_like(layers.witnesses, witnesses))


def windows_of(
    scene: Boards, factors: Array | None, noise: float = 0.0, units_m: tuple[float, float] = (1, 1)
) -> tuple[Window, Window]:
    """Return a window that is right, and the next one, distorted."""
    first = scene.window(np.arange(NUM), None, noise, units_m[0])
    start = NUM - OVERLAP
    return first, scene.window(np.arange(start, start + NUM), factors, noise, units_m[1])


def align(
    pair: tuple[Window, Window], config: LayersConfig, witnesses: float = MANY
) -> tuple[Layers, LayerCounts]:
    """Align the second window of a pair with the first, given the true scale between them."""
    first, second = pair
    block = config.segmentation.downscale
    before = known(first_layers(first.labels(block)), witnesses)
    scale = second.unit_m / first.unit_m
    return align_layers(
        (first.prediction, before), second.prediction, second.labels(block), scale, config
    )


def errors(pair: tuple[Window, Window], layers: Layers, config: LayersConfig) -> Array:
    """Return |log error| of the second window's corrected depth."""
    corrected = apply_layers(pair[1].prediction, layers, config)
    return np.abs(pair[1].log_error(corrected.depth))


def scale_of_pixels(layers: Layers) -> Array:
    rows = np.split(layers.scales, layers.starts[1:-1])
    tables = [np.append(1.0, row) for row in rows]
    return np.stack([row[labels] for row, labels in zip(tables, layers.labels, strict=True)])


# --- recovery -----------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ["median", "huber", "l1", "closed_form"])
def test_each_layer_gets_the_inverse_of_its_factor_in_shared_and_in_new_frames(
    estimator: str,
) -> None:
    scene = Boards(1)
    factors = scene.random_factors(1)
    pair = windows_of(scene, factors)
    layers, counts = align(pair, plain(scale=estimator))
    np.testing.assert_allclose(scale_of_pixels(layers), 1 / factors[pair[1].ids], rtol=1e-4)
    assert counts.layers == counts.reached == len(layers.scales)
    assert counts.linked == layers.starts[OVERLAP]
    assert counts.refused == 0
    assert counts.mismatch_before is not None
    assert counts.mismatch_after is not None
    shared = np.log(factors[pair[1].ids[:OVERLAP]])
    assert counts.mismatch_before == pytest.approx(np.median(np.abs(shared)), rel=1e-3)
    assert counts.mismatch_after < 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_noisy_windows_lose_most_of_their_layers_error(seed: int) -> None:
    scene, config = Boards(seed), settings()
    pair = windows_of(scene, scene.random_factors(seed), noise=0.01)
    layers, counts = align(pair, config)
    before = np.abs(pair[1].log_error(pair[1].prediction.depth))
    after = errors(pair, layers, config)
    assert after[:OVERLAP].mean() < 0.35 * before[:OVERLAP].mean()
    assert after[OVERLAP:].mean() < 0.35 * before[OVERLAP:].mean()
    assert counts.layer_sigma + counts.curve_sigma > 0.02


def test_an_exact_window_without_distortion_is_left_bit_for_bit() -> None:
    pair, config = windows_of(Boards(0), None), settings()
    layers, _ = align(pair, config)
    assert (layers.scales == 1).all()
    corrected = apply_layers(pair[1].prediction, layers, config)
    assert np.array_equal(corrected.depth, pair[1].prediction.depth)


@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_is_no_reason_to_change_a_window(seed: int) -> None:
    pair, config = windows_of(Boards(seed), None, noise=0.02), settings()
    before = np.abs(pair[1].log_error(pair[1].prediction.depth)).mean()
    assert errors(pair, align(pair, config)[0], config).mean() < 1.02 * before


def test_the_current_window_counts_as_one_opinion_among_all() -> None:
    """One window behind the layers before: the mean of two. Three: three quarters."""
    scene, config = Boards(2), settings(shrink=False, feather=0, tau_intra=0.3)
    factors = scene.random_factors(2)
    pair = windows_of(scene, factors)
    logs = -np.log(factors[pair[1].ids])
    for witnesses, share in ((1, 1 / 2), (3, 3 / 4), (19, 19 / 20)):
        layers, _ = align(pair, config, witnesses)
        np.testing.assert_allclose(np.log(scale_of_pixels(layers)), share * logs, atol=1e-4)
        assert layers.witnesses == pytest.approx(min(witnesses + 1, config.memory))


def test_without_edges_in_the_window_new_frames_keep_their_depth() -> None:
    scene = Boards(1)
    pair = windows_of(scene, scene.random_factors(1))
    layers, counts = align(pair, plain(intra=False))
    pixels = scale_of_pixels(layers)
    assert (pixels[OVERLAP:] == 1).all()
    assert (pixels[:OVERLAP] != 1).mean() > 0.9
    assert counts.reached == layers.starts[OVERLAP]


def test_scales_of_fast_boards_follow_depth_and_poses_only() -> None:
    """Boards move by their own width from frame to frame: the same pixels show others."""
    scene = Boards(3, speed_m=1.2)
    factors = scene.random_factors(3)
    pair = windows_of(scene, factors)
    after = {}
    for follow in (True, False):
        config = plain(follow=follow)
        layers, _ = align(pair, config)
        seen = np.isin(pair[1].ids, pair[1].ids[:OVERLAP]) & (pair[1].ids > 0)
        after[follow] = errors(pair, layers, config)[OVERLAP:][seen[OVERLAP:]].mean()
    assert after[True] < 0.5 * after[False]


def test_a_smooth_distortion_over_depth_is_undone_for_layers_never_seen_before() -> None:
    """The new frames look elsewhere: only the curve knows."""
    scene, config = Boards(5, num=30), settings()
    depths = np.append(25.0, scene.boxes[:, 4])
    pair = windows_of(scene, np.exp(0.12 * np.sin(1.5 * np.log(depths))), noise=0.005)
    first, second = pair
    elsewhere = Boards(6, num=30).window(np.arange(NUM, NUM + 3))
    bent = elsewhere.truth * np.exp(0.12 * np.sin(1.5 * np.log(elsewhere.truth)))
    prediction = second.prediction
    prediction.depth[OVERLAP:] = bent
    labels = np.concatenate([second.labels()[:OVERLAP], elsewhere.labels()])
    before = known(first_layers(first.labels()))
    layers, counts = align_layers((first.prediction, before), prediction, labels, 1.0, config)
    assert counts.curve_sigma > 0.03
    assert len(layers.curve) > 2
    corrected = apply_layers(prediction, layers, config).depth[OVERLAP:]
    after = np.abs(np.log(corrected / elsewhere.truth)).mean()
    assert after < 0.6 * np.abs(np.log(bent / elsewhere.truth)).mean()


# --- units and places ---------------------------------------------------------------------------


@pytest.mark.parametrize("units_m", [(1.0, 0.01), (1.0, 100.0), (100.0, 1.0), (0.01, 0.01)])
@pytest.mark.parametrize("config", [settings(2), plain(2)], ids=["default", "plain"])
def test_partition_and_scales_have_no_unit(
    units_m: tuple[float, float], config: LayersConfig
) -> None:
    scene = Boards(1)
    factors = scene.random_factors(1, 0.07)
    metric, other = (windows_of(scene, factors, 0.01, units) for units in ((1.0, 1.0), units_m))
    segmenter = make_segmenter(config.segmentation)
    found = []
    for first, second in (metric, other):
        labels = [segmenter.segment(w.prediction, w.colors) for w in (first, second)]
        before = (first.prediction, known(first_layers(labels[0])))
        scale = second.unit_m / first.unit_m
        layers, counts = align_layers(before, second.prediction, labels[1], scale, config)
        depth = apply_layers(second.prediction, layers, config).depth * second.unit_m
        found.append((layers, counts, depth))
    (a, counts_a, depth_a), (b, counts_b, depth_b) = found
    assert np.array_equal(a.labels, b.labels)
    assert len(np.unique(a.labels)) > 8
    assert np.ptp(a.scales) > 0.1
    np.testing.assert_allclose(b.scales, a.scales, rtol=2e-3)
    assert np.median(np.abs(b.scales - a.scales)) < 1e-4
    np.testing.assert_allclose(b.witnesses, a.witnesses)
    np.testing.assert_allclose(depth_b, depth_a, rtol=2e-3)
    assert (counts_a.linked, counts_a.reached) == (counts_b.linked, counts_b.reached)


@pytest.mark.parametrize("seed", range(3))
def test_layers_go_along_with_a_node_that_moves(seed: int) -> None:
    """Moved and then corrected is corrected and then moved."""
    rng = np.random.default_rng(seed)
    scene, config = Boards(seed), settings(2)
    pair = windows_of(scene, scene.random_factors(seed), 0.01)
    layers, _ = align(pair, config)
    depths = np.geomspace(3, 30, 5)
    layers = replace(layers, curve=np.stack([depths, rng.uniform(0.8, 1.2, 5)], axis=1))
    move = Sim3(float(rng.uniform(0.2, 5)), rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    window = pair[1].prediction
    moved_window = replace(
        window,
        depth=(move.scale * window.depth).astype(np.float32),
        window_from_cam=move.apply_poses(window.window_from_cam),
    )
    moved_layers = replace(layers, curve=layers.curve * [move.scale, 1.0])
    corrected = points_of(apply_layers(window, layers, config))
    moved = points_of(apply_layers(moved_window, moved_layers, config))
    assert np.ptp(corrected / points_of(window)) > 0.2
    np.testing.assert_allclose(moved, move.apply(corrected), atol=2e-4 * move.scale)


def points_of(window: Prediction) -> Array:
    """Return (N * H * W, 3) points in the window's frame."""
    out = []
    for depth, K, pose in zip(window.depth, window.intrinsics, window.window_from_cam, strict=True):
        out.append(unproject(depth, K).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(out)


# --- many windows -------------------------------------------------------------------------------


def chain(config: LayersConfig, num: int, seed: int, sigma: float = 0.1) -> tuple[Array, Array]:
    """Align windows whose layers are distorted independently.

    Returns:
        (num,) rms over the boards of each window's log error after its correction, and (num,) the
        largest |log scale|.
    """
    scene = Boards(seed, size=(36, 72), speed_m=0.005, num=10)
    previous: tuple[Prediction, Layers] | None = None
    after, largest = [], []
    for k in range(num):
        factors = scene.random_factors(1000 * seed + k, sigma)
        window = scene.window(np.arange(2 * k, 2 * k + NUM), factors, noise=0.005)
        if previous is None:
            layers = first_layers(window.labels())
        else:
            layers, _ = align_layers(previous, window.prediction, window.labels(), 1.0, config)
        corrected = apply_layers(window.prediction, layers, config)
        error = window.log_error(corrected.depth).ravel()
        ids = window.ids.ravel()
        of_board = np.bincount(ids, error) / np.maximum(np.bincount(ids), 1)
        after.append(np.sqrt(np.mean(of_board**2)))
        largest.append(np.abs(np.log(layers.scales)).max())
        previous = window.prediction, layers
    return np.array(after), np.array(largest)


def test_with_memory_the_error_falls_as_that_of_a_mean_of_all_windows() -> None:
    config = settings(shrink=False, feather=0)
    after = np.mean([chain(config, 14, seed)[0] for seed in range(6)], axis=0)
    np.testing.assert_allclose(after / after[0], 1 / np.sqrt(np.arange(1, 15)), atol=0.12)


def test_by_default_the_error_falls_with_the_number_of_windows() -> None:
    after = np.mean([chain(settings(), 14, seed)[0] for seed in range(6)], axis=0)
    assert after[1] < 0.95 * after[0]  # 0.71 is the mean of two, without any doubt of it
    assert after[4:7].mean() < 0.65 * after[0]
    assert after[10:].mean() < 0.6 * after[0]


@pytest.mark.parametrize("seed", [1, 2])
def test_corrections_never_walk_away(seed: int) -> None:
    """Distortions of up to 20 % are undone for ever, by no more than it takes."""
    sigma = 0.1
    after, largest = chain(settings(), 30, seed, sigma)
    assert after[20:].mean() < 0.6 * sigma
    assert largest[20:].max() < 3 * sigma  # the largest factor of 2 sigma, and a mean's error


def test_noise_alone_does_not_grow_over_the_windows() -> None:
    after, largest = chain(settings(), 25, 2, sigma=0.0)
    assert after.max() < 0.002  # of 0.005 a pixel
    assert largest.max() < 0.002


def test_without_memory_each_window_takes_over_what_the_one_before_says() -> None:
    after, largest = chain(plain(), 10, 3)
    np.testing.assert_allclose(after, after[0], rtol=0.05)
    assert (largest[1:] > 0.1).all()


# --- bounds and gates ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("max_scale", [1.05, 1.6])
def test_scales_stay_within_bounds_whatever_depth_says(seed: int, max_scale: float) -> None:
    rng = np.random.default_rng(seed)
    first, second = windows_of(Boards(seed), None)
    second.prediction.depth[:] *= rng.lognormal(0, 0.5, second.truth.shape)
    for config in (settings(max_scale=max_scale), plain(max_scale=max_scale, max_spread=9)):
        layers, _ = align((first, second), config)
        assert np.isfinite(layers.scales).all()
        assert layers.scales.max() <= max_scale * (1 + 1e-12)
        assert layers.scales.min() >= 1 / max_scale * (1 - 1e-12)


def board_and_rest(config: LayersConfig, change: Array) -> tuple[float, float, LayerCounts]:
    """Distort board 9 by (N, H, W) ``change``, all others by 1.1.

    Returns:
        The mean scale of the board, of the rest, and the counts.
    """
    scene = Boards(1)
    first, second = windows_of(scene, None)
    is_board = second.ids == 9
    assert is_board.any(axis=(1, 2)).all()
    second.prediction.depth[:] *= np.where(is_board, change, 1.1)
    layers, counts = align((first, second), config)
    pixels = scale_of_pixels(layers)
    return float(pixels[is_board].mean()), float(pixels[~is_board].mean()), counts


def test_layers_beyond_the_range_are_refused() -> None:
    board, rest, counts = board_and_rest(plain(), np.full(1, 2.0))
    assert board == 1
    assert rest == pytest.approx(1 / 1.1, abs=2e-3)
    assert counts.refused == OVERLAP
    assert board_and_rest(plain(max_scale=2.5), np.full(1, 2.0))[0] == pytest.approx(0.5, abs=1e-3)


def test_layers_without_one_scale_are_refused() -> None:
    torn = np.where(np.arange(96) % 2, 0.75, 1.35)
    board, rest, counts = board_and_rest(plain(), torn)
    assert board == 1
    assert rest == pytest.approx(1 / 1.1, abs=2e-3)
    assert counts.refused == OVERLAP
    assert board_and_rest(plain(max_spread=1.0), torn)[2].refused == 0


def test_layers_of_few_cells_are_refused() -> None:
    scene = Boards(1)
    first, second = windows_of(scene, scene.random_factors(1))
    cells = np.stack([np.bincount(ids.ravel(), minlength=15) for ids in second.ids[:OVERLAP]])
    limit = float(np.median(cells[cells > 0]))
    layers, counts = align((first, second), plain(min_support=limit / second.ids[0].size))
    assert counts.refused == ((cells > 0) & (cells < limit)).sum()
    assert 10 < counts.refused < counts.linked - 10
    few = cells[0][second.ids[0]] < limit
    assert (scale_of_pixels(layers)[0][few] == 1).all()
    assert (scale_of_pixels(layers)[0][~few] != 1).all()


def test_cells_without_confidence_have_no_say() -> None:
    scene = Boards(1)
    factors = scene.random_factors(1)
    pair = windows_of(scene, factors)
    lies = np.random.default_rng(0).random(pair[1].truth.shape) < 0.6
    pair[1].prediction.depth[lies] *= 1.4
    pair[1].prediction.confidence[lies] = 0
    layers, _ = align(pair, plain(max_spread=9))
    is_right = np.isclose(scale_of_pixels(layers), 1 / factors[pair[1].ids], rtol=1e-4)
    assert is_right.mean() > 0.999  # the rest: slivers of nothing but lies


def test_cells_weigh_by_their_confidence_or_all_alike() -> None:
    scene = Boards(1)
    pair = windows_of(scene, None)
    doubted = np.random.default_rng(0).random(pair[1].truth.shape) < 0.6
    pair[1].prediction.depth[doubted] *= 1.3
    pair[1].prediction.confidence[doubted] = 0.01
    trusting, _ = align(pair, plain(max_spread=9, confidence=False))
    knowing, _ = align(pair, plain(max_spread=9))
    assert np.median(scale_of_pixels(knowing)) == pytest.approx(1, abs=1e-4)
    assert np.median(scale_of_pixels(trusting)) == pytest.approx(1 / 1.3, abs=1e-4)


# --- the correction -----------------------------------------------------------------------------

SIZES = [(36, 72), (37, 71), (31, 50)]


def one_frame(depth: Array) -> Prediction:
    return Prediction(
        np.arange(1),
        depth[None].astype(np.float32),
        np.full((1, *depth.shape), 0.8, np.float32),
        np.eye(4)[None],
        np.array([[[60.0, 0, 35.5], [0, 60.0, 17.5], [0, 0, 1]]]),
    )


def layers_of(labels: NDArray[np.integer], scales: list[float]) -> Layers:
    plain_layers = first_layers(labels[None].astype(np.uint16))
    return replace(plain_layers, scales=np.array(scales))


@pytest.mark.parametrize("block", [1, 2, 3])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("feather", [0, 16])
def test_one_layer_is_scaled_as_a_whole(size: tuple[int, int], block: int, feather: float) -> None:
    rng = np.random.default_rng(0)
    window = one_frame(rng.lognormal(1, 0.5, size))
    labels = np.ones(size, int)[::block, ::block]
    config = settings(block, feather=feather)
    out = apply_layers(window, layers_of(labels, [1.2]), config)
    np.testing.assert_allclose(out.depth, 1.2 * window.depth, rtol=1e-5)
    before, after = points_of(window), points_of(out)
    np.testing.assert_allclose(after, 1.2 * before, rtol=1e-5)  # along the ray
    assert np.array_equal(out.window_from_cam, window.window_from_cam)


@pytest.mark.parametrize("block", [1, 2, 3])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("feather", [0, 16])
def test_layers_at_other_depths_keep_their_own_scale_to_the_last_pixel(
    size: tuple[int, int], block: int, feather: float
) -> None:
    """Neither feathering nor coarse cells bleed across a step of depth."""
    v, u = np.mgrid[: size[0], : size[1]]
    which = (u + v // 3 > 23).astype(int) + ((u > 33) & (v > 11))
    depth, scales = np.array([3.0, 7.0, 14.0])[which], np.array([0.85, 1.1, 1.25])
    labels = which[::block, ::block] + 1
    out = apply_layers(
        one_frame(depth), layers_of(labels, scales.tolist()), settings(block, feather=feather)
    )
    np.testing.assert_allclose(out.depth[0] / depth, scales[which], rtol=0.005)


def slope_in_two() -> tuple[Prediction, NDArray[np.int64]]:
    """One surface that a segmenter cut in the middle."""
    v, u = np.mgrid[:48, :96]
    return one_frame(5.0 + 0.01 * u + 0.005 * v), np.where(u < 48, 1, 2)


@pytest.mark.parametrize("block", [1, 2, 3])
def test_feathering_leaves_no_step_where_a_surface_goes_on(block: int) -> None:
    window, labels = slope_in_two()
    layers = layers_of(labels[::block, ::block], [0.9, 1.1])
    steps = {}
    for feather in (0, 16):
        out = apply_layers(window, layers, settings(block, feather=feather))
        factor = np.log(out.depth[0] / window.depth[0])
        steps[feather] = float(np.abs(np.diff(factor, axis=1)).max())
        ends = factor[:, [0, -1]].mean(axis=0)
        np.testing.assert_allclose(ends, np.log([0.9, 1.1]), atol=0.02)
        assert np.abs(np.diff(factor, axis=0)).max() < 2e-3
    assert steps[16] < 0.1 * np.log(1.1 / 0.9)
    assert steps[16] < 0.3 * steps[0]


def test_feathering_keeps_the_mean_of_a_surface() -> None:
    window, labels = slope_in_two()
    out = apply_layers(window, layers_of(labels, [0.9, 1 / 0.9]), settings(feather=16))
    assert np.log(out.depth / window.depth).mean() == pytest.approx(0, abs=0.004)


def test_a_surface_that_ends_at_unknown_depth_ends_there() -> None:
    window, labels = slope_in_two()
    window.depth[0, :, 46:50], window.confidence[0, :, 46:50] = np.nan, 0
    out = apply_layers(window, layers_of(labels, [0.9, 1.1]), settings(feather=16))
    ratio = out.depth[0] / window.depth[0]
    np.testing.assert_allclose(ratio[:, :46], 0.9, rtol=1e-5)
    np.testing.assert_allclose(ratio[:, 50:], 1.1, rtol=1e-5)


@pytest.mark.parametrize("block", [1, 2, 3])
def test_unknown_depth_stays_unknown_and_known_depth_known(block: int) -> None:
    rng = np.random.default_rng(block)
    window, labels = slope_in_two()
    lost = rng.random((48, 96)) < 0.3
    odd = rng.choice([np.nan, np.inf, 0.0, -1.0], size=int(lost.sum()))
    window.depth[0, lost], window.confidence[0, lost] = odd, 0
    cells = np.where(rng.random((48, 96)) < 0.1, 0, labels)[::block, ::block]
    layers = replace(layers_of(cells, [0.9, 1.1]), curve=np.array([[4.0, 0.9], [7.0, 1.1]]))
    out = apply_layers(window, layers, settings(block)).depth[0]
    assert np.array_equal(out[lost], odd.astype(np.float32), equal_nan=True)
    assert np.isfinite(out[~lost]).all()
    assert (out[~lost] > 0.75 * window.depth[0][~lost]).all()
    assert (out[~lost] < 1.25 * window.depth[0][~lost]).all()


@pytest.mark.parametrize("block", [1, 2])
def test_a_curve_holds_at_every_depth_and_its_ends_beyond(block: int) -> None:
    depth = np.geomspace(1, 40, 96)[None].repeat(48, axis=0)
    curve = np.array([[2.0, 0.9], [8.0, 1.2], [20.0, 1.0]])
    labels = np.ones((48, 96), int)[::block, ::block]
    layers = replace(layers_of(labels, [1.0]), curve=curve)
    out = apply_layers(one_frame(depth), layers, settings(block)).depth[0]
    expected = np.exp(np.interp(np.log(depth), *np.log(curve).T))
    np.testing.assert_allclose(out / depth, expected, atol=0.006)


def test_factors_of_one_give_the_same_bits() -> None:
    window, labels = slope_in_two()
    window.depth[0, 3:9] = np.nan
    window.confidence[0, 3:9] = 0
    out = apply_layers(window, first_layers(labels[None].astype(np.uint16)), settings())
    assert np.array_equal(out.depth, window.depth, equal_nan=True)
    assert out.depth.dtype == np.float32


# --- bad input ----------------------------------------------------------------------------------


def test_windows_that_share_no_frame_leave_all_scales_at_one() -> None:
    scene = Boards(0)
    first, second = scene.window(np.arange(5)), scene.window(np.arange(7, 12))
    layers, counts = align((first, second), settings())
    assert (layers.scales == 1).all()
    assert (layers.witnesses == 1).all()
    assert counts == LayerCounts(len(layers.scales))
    assert counts.mismatch_before is None


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("config", [settings(), plain()], ids=["default", "plain"])
def test_a_window_without_depth_has_no_layers_and_teaches_none(
    side: int, config: LayersConfig
) -> None:
    pair = windows_of(Boards(0), None)
    pair[side].prediction.depth[:], pair[side].prediction.confidence[:] = np.nan, 0
    labels = [window.labels() for window in pair]
    labels[side][:] = 0
    before = pair[0].prediction, first_layers(labels[0])
    layers, counts = align_layers(before, pair[1].prediction, labels[1], 1.0, config)
    assert (layers.scales == 1).all()
    assert len(layers.scales) == (0 if side else first_layers(labels[1]).starts[-1])
    assert counts.linked == counts.reached == 0
    assert counts.mismatch_after is None


@pytest.mark.parametrize("config", [settings(), plain()], ids=["default", "plain"])
def test_depth_in_which_nobody_trusts_moves_nothing(config: LayersConfig) -> None:
    scene = Boards(0)
    pair = windows_of(scene, scene.random_factors(0))
    pair[1].prediction.confidence[:] = 0
    layers, counts = align(pair, config)
    assert (layers.scales == 1).all()
    assert counts.linked == counts.refused > 0
    assert counts.mismatch_before is None


@pytest.mark.parametrize("config", [settings(), plain()], ids=["default", "plain"])
@pytest.mark.parametrize("factor", [1.0, 1.2])
def test_a_constant_depth_that_is_one_layer_is_as_good_as_any(
    config: LayersConfig, factor: float
) -> None:
    scene = Boards(0, num=0)
    pair = windows_of(scene, np.full(1, factor))
    layers, counts = align(pair, config)
    assert counts.layers == len(layers.scales) == NUM
    assert np.isfinite(layers.scales).all()
    scaled = apply_layers(pair[1].prediction, layers, config).depth
    assert np.isfinite(scaled).all()
    assert np.abs(pair[1].log_error(scaled)).max() <= abs(np.log(factor)) + 1e-4
    if not config.shrink:
        np.testing.assert_allclose(layers.scales, 1 / factor, rtol=1e-4)


ALWAYS = load_config(assignments=["layers.enabled=always"])


def run_slam(windows: list[Prediction], config: Config = ALWAYS) -> tuple[Slam, list[Prediction]]:
    slam = Slam(config)
    out = []
    for window in windows:
        colors = np.full((*window.depth.shape, 3), 100, np.uint8)
        out.append(slam.add(window, colors).prediction)
    return slam, out


def corridor_windows(num: int = 4) -> list[Prediction]:
    return [true_prediction(np.arange(5 * k, 5 * k + 8), 1.0 + k) for k in range(num)]


@pytest.mark.parametrize("bad", [0, 1, 2])
@pytest.mark.parametrize(
    "how", ["static", "rotation", "failed", "unknown", "constant", "no confidence"]
)
def test_slam_bears_a_window_of_bad_depth_and_counts_its_layers(bad: int, how: str) -> None:
    windows = corridor_windows()
    window = windows[bad]
    if how in set(WindowStatus):
        windows[bad] = true_prediction(window.frames, 2.0, WindowStatus(how))
    elif how == "unknown":
        window.depth[:], window.confidence[:] = np.nan, 0
    elif how == "constant":
        window.depth[:] = 3.0
    else:
        window.confidence[:] = 0
    slam, corrected = run_slam(windows)
    counts = [node.layers for node in slam.nodes]
    for node, given, out in zip(slam.nodes, windows, corrected, strict=True):
        assert node.layers is not None
        assert np.array_equal(np.isnan(out.depth), np.isnan(given.depth))
        ratio = out.depth / given.depth
        assert np.nanmax(ratio, initial=1) < 2
        assert np.nanmin(ratio, initial=1) > 0.5
    found = counts[bad]
    assert found is not None
    if how == "constant":
        assert found.layers == 8
    else:
        assert found == LayerCounts(0)
    after = counts[bad + 1]
    assert after is not None
    assert after.layers > 0
    if how != "constant":
        assert after == LayerCounts(after.layers)  # bridged: nothing to compare with
    assert np.isfinite(slam.trajectory(np.arange(99.0)).world_from_cam).all()


def test_slam_leaves_layers_alone_where_they_are_switched_off() -> None:
    never = load_config(assignments=["layers.enabled=never"])
    slam, out = run_slam(corridor_windows(), never)
    assert slam.layers is None
    assert all(node.layers is None for node in slam.nodes)
    for given, got in zip(corridor_windows(), out, strict=True):
        assert np.array_equal(given.depth, got.depth)


def bent_windows() -> list[Prediction]:
    """Bend depth smoothly, differently in each window."""
    windows = corridor_windows()
    for k, window in enumerate(windows):
        log_depth = np.log(window.depth / np.median(window.depth))
        window.depth[:] *= np.exp(0.12 * np.sin(1.5 * log_depth + 2.0 * k))
    return windows


def test_layers_move_cameras_only_where_they_are_told_to_feed_back() -> None:
    never = load_config(assignments=["layers.enabled=never"])
    feeding = load_config(assignments=["layers.enabled=always", "layers.feed_back=true"])
    times = np.arange(99.0)
    paths = [
        run_slam(bent_windows(), config)[0].trajectory(times).world_from_cam
        for config in (never, ALWAYS, feeding)
    ]
    assert np.array_equal(paths[0], paths[1])
    assert not np.allclose(paths[0], paths[2], atol=1e-4)
    assert np.isfinite(paths[2]).all()


def test_true_windows_of_the_corridor_stay_true_through_slam() -> None:
    """Units differ from window to window; nothing else does."""
    windows = corridor_windows()
    slam, out = run_slam(windows)
    for given, got in zip(windows, out, strict=True):
        np.testing.assert_allclose(got.depth, given.depth, rtol=2e-3)
        assert np.median(np.abs(got.depth / given.depth - 1)) < 1e-3
    last = slam.nodes[-1].layers
    assert last is not None
    assert last.linked > 3
    assert last.mismatch_after is not None
    assert last.mismatch_after < 1e-3
    assert slam.layers is not None
    assert slam.layers.labels.shape == (8, CORRIDOR[0] // 2, CORRIDOR[1] // 2)


# --- distorted streets --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "overlap", "new"),
    [
        ("objects, noise 1 %", (0.0, 0.6), (0.0, 0.8)),
        ("rigid, noise 1 %", (0.9, 1.03), (0.9, 1.04)),
        ("smooth in log depth", (0.0, 0.35), (0.0, 0.4)),
    ],
)
def test_a_distorted_street_is_mended_in_bands(
    case: str, overlap: tuple[float, float], new: tuple[float, float]
) -> None:
    figures = measure(make_pair(CASES[case], 0, (77, 259)), Config(), 20.0)
    for (before, after), (low, high) in zip(
        (figures[2:4], figures[4:6]), (overlap, new), strict=True
    ):
        assert low * before <= after <= high * before
