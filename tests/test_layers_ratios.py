"""Ratios of layers between two windows, and what of them is distortion."""

import warnings
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from laser_slam.layers.ratios import RATIO_ESTIMATORS, Pairs, Ratios, measure_ratios
from laser_slam.layers.shrinkage import Distortion, Observations, explain

Array = NDArray[np.float64]
Float = NDArray[np.float32]
ESTIMATORS = sorted(RATIO_ESTIMATORS)
REACH = 1.4  # log-ratios beyond it look alike
RESOLUTION = 4.3e-5  # a bin of the second histogram


@pytest.fixture(autouse=True)
def no_warning() -> Iterator[None]:
    """Nothing here may divide by zero on the way."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def random_pairs(seed: int, num_groups: int = 12, spread: float = 0.1) -> Pairs:
    """Groups of 1 to 400 pixels, each with a scale of its own, noise, and some outliers."""
    rng = np.random.default_rng(seed)
    group = rng.permutation(np.repeat(np.arange(num_groups), rng.integers(1, 400, num_groups)))
    source = rng.lognormal(1.0, 0.5, len(group))
    log_ratio = rng.uniform(-0.4, 0.4, num_groups)[group] + spread * rng.normal(size=len(group))
    log_ratio[rng.random(len(group)) < 0.1] += 0.7
    return pairs_of(source, source * np.exp(log_ratio), group, rng.uniform(0.05, 1, len(group)))


def pairs_of(
    source: Array | Float,
    target: Array | Float,
    group: NDArray[np.int64] | None = None,
    weight: Array | Float | None = None,
    num_groups: int = 0,
) -> Pairs:
    group = np.zeros(len(source), np.int64) if group is None else group
    weight = np.ones(len(source)) if weight is None else weight
    num = num_groups or int(group.max()) + 1
    return Pairs(group, single(source), single(target), single(weight), num)


def single(values: Array | Float) -> Float:
    return np.asarray(values, np.float32)


def each_group(pairs: Pairs) -> Iterator[tuple[int, Array, Array, Array]]:
    """Yield the group and its sources, targets and weights, in float64."""
    for g in np.unique(pairs.group):
        here = pairs.group == g
        source, target, weight = (
            values[here].astype(np.float64) for values in (pairs.source, pairs.target, pairs.weight)
        )
        yield int(g), source, target, weight


def quantile(values: Array, weight: Array, share: float) -> float:
    """Return the first value with at least that share of the weight up to it."""
    order = np.argsort(values)
    mass = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(mass, share * mass[-1] * (1 - 1e-9))])


def said(pairs: Pairs, estimator: str) -> Array:
    return measure_ratios(pairs, estimator).log_ratio


# --- estimators against slow versions of themselves ---------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_median_is_the_weighted_median_of_the_log_ratios(seed: int) -> None:
    pairs = random_pairs(seed)
    found = said(pairs, "median")
    for g, source, target, weight in each_group(pairs):
        expected = quantile(np.log(target / source), weight, 0.5)
        assert found[g] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_l1_is_the_scale_that_no_other_ratio_betters(seed: int) -> None:
    """A sum of absolute values has its minimum at one of its kinks: try them all."""
    pairs = random_pairs(seed)
    found = np.exp(said(pairs, "l1"))
    for g, source, target, weight in each_group(pairs):
        kinks = target / source
        losses = (weight * np.abs(kinks[:, None] * source - target)).sum(axis=1)
        at_found = float((weight * np.abs(found[g] * source - target)).sum())
        slope = float((weight * source).sum())
        assert at_found <= losses.min() + 1.5 * RESOLUTION * found[g] * slope


def slow_huber(source: Array, target: Array) -> float:
    """Minimise the sum of Huber losses on ``|s * source - target|``, one group alone."""
    bend = 0.1 * float(target.mean())

    def loss(log_scale: float) -> float:
        errors = np.abs(np.exp(log_scale) * source - target)
        huber = np.where(errors < bend, 0.5 * errors**2, bend * (errors - 0.5 * bend))
        return float(huber.sum())

    start = float(np.median(np.log(target / source)))
    bounds = (start - 0.5, start + 0.5)
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-9})
    return float(found.x)


@pytest.mark.parametrize("seed", range(5))
def test_huber_is_the_minimum_of_its_loss(seed: int) -> None:
    pairs = random_pairs(seed)
    pairs.weight[:] = 1
    found = said(pairs, "huber")
    for g, source, target, _ in each_group(pairs):
        assert found[g] == pytest.approx(slow_huber(source, target), abs=2e-4)


@pytest.mark.parametrize("seed", range(3))
def test_closed_form_is_least_squares(seed: int) -> None:
    pairs = random_pairs(seed)
    found = np.exp(said(pairs, "closed_form"))
    for g, source, target, _ in each_group(pairs):
        expected = np.linalg.lstsq(source[:, None], target, rcond=None)[0][0]
        assert found[g] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_the_spread_is_the_distance_of_the_quartiles(seed: int) -> None:
    pairs = random_pairs(seed)
    ratios = measure_ratios(pairs, "median")
    one_bin = 2 * REACH / 256
    for g, source, target, weight in each_group(pairs):
        if len(source) < 30:
            continue
        low, high = (quantile(np.log(target / source), weight, share) for share in (0.25, 0.75))
        assert ratios.spread[g] * 1.349 == pytest.approx(high - low, abs=one_bin)


def test_the_spread_of_normal_noise_is_its_standard_deviation() -> None:
    noise = 0.08 * np.random.default_rng(0).normal(size=20_000)
    ratios = measure_ratios(pairs_of(np.ones(20_000), np.exp(noise)), "median")
    assert ratios.spread[0] == pytest.approx(0.08, rel=0.03)


@pytest.mark.parametrize("estimator", ["median", "l1"])
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_third_of_outliers_moves_a_median_by_less_than_the_noise(
    estimator: str, share: float
) -> None:
    rng = np.random.default_rng(1)
    log_ratio = 0.2 + 0.02 * rng.normal(size=3000)
    log_ratio[: int(share * 3000)] += 0.9
    source = rng.lognormal(0, 0.3, 3000)
    found = said(pairs_of(source, source * np.exp(log_ratio)), estimator)
    assert found[0] == pytest.approx(0.2, abs=0.02)


def test_weights_decide_the_median_and_l1() -> None:
    source, target = np.ones(5), np.exp([0.3, 0.3, -0.2, -0.2, -0.2])
    weight = np.array([1.0, 1.0, 0.1, 0.1, 0.1])
    for estimator in ("median", "l1"):
        found = said(pairs_of(source, target, weight=weight), estimator)
        assert found[0] == pytest.approx(0.3, abs=1e-4)


# --- the corners --------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_pixels_that_agree_are_heard_at_every_ratio(estimator: str) -> None:
    """Also at the borders of a histogram's bins, and a rounding error to either side of them."""
    borders = np.arange(-120, 121) * 2 * REACH / 256
    ratios = np.concatenate([borders + k * 3e-8 for k in range(-6, 7)])
    group = np.repeat(np.arange(len(ratios)), 3)
    found = said(pairs_of(np.ones(len(group)), np.exp(ratios)[group], group), estimator)
    np.testing.assert_allclose(found, ratios, atol=RESOLUTION)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_one_pixel_says_its_ratio(estimator: str) -> None:
    ratios = measure_ratios(pairs_of(np.array([2.0]), np.array([2.4])), estimator)
    assert ratios.log_ratio[0] == pytest.approx(np.log(1.2), abs=RESOLUTION)
    assert ratios.support.tolist() == [1]
    assert ratios.spread[0] < 0.006  # less than a bin


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_groups_without_pixels_say_nothing(estimator: str) -> None:
    pairs = pairs_of(np.ones(4), np.full(4, 1.1), np.array([1, 1, 3, 3]), num_groups=6)
    ratios = measure_ratios(pairs, estimator)
    assert np.isnan(ratios.log_ratio).tolist() == [True, False, True, False, True, True]
    np.testing.assert_allclose(ratios.log_ratio[[1, 3]], np.log(1.1), atol=RESOLUTION)
    assert ratios.support.tolist() == [0, 2, 0, 2, 0, 0]
    assert np.isfinite(ratios.spread).all()


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_no_pixels_at_all_are_no_error(estimator: str) -> None:
    none = np.empty(0)
    ratios = measure_ratios(pairs_of(none, none, np.empty(0, np.int64), num_groups=2), estimator)
    assert np.isnan(ratios.log_ratio).all()
    assert measure_nothing(estimator).log_ratio.shape == (0,)


def measure_nothing(estimator: str) -> Ratios:
    none = np.empty(0, np.float32)
    return measure_ratios(Pairs(np.empty(0, np.int64), none, none, none, 0), estimator)


@pytest.mark.parametrize("estimator", ["median", "l1"])
@pytest.mark.parametrize("factor", [1e-6, 0.1, 9.0, 1e6])
def test_ratios_out_of_reach_look_like_the_farthest(estimator: str, factor: float) -> None:
    """Whoever bounds scales at less than four refuses them."""
    source, target = np.ones(5), np.array([factor, factor, factor, 1.0, 1.0])
    found = said(pairs_of(source, target), estimator)
    assert found[0] == pytest.approx(np.sign(np.log(factor)) * REACH, abs=0.002)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_ratios_have_no_unit(estimator: str, unit: float) -> None:
    pairs = random_pairs(0)
    scaled = pairs_of(unit * pairs.source, unit * pairs.target, pairs.group, pairs.weight)
    np.testing.assert_allclose(said(scaled, estimator), said(pairs, estimator), atol=RESOLUTION)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_one_group_does_not_hear_the_others(estimator: str) -> None:
    pairs = random_pairs(2)
    together = said(pairs, estimator)
    for g, source, target, weight in each_group(pairs):
        alone = said(pairs_of(source, target, weight=weight), estimator)
        assert together[g] == pytest.approx(alone[0], abs=RESOLUTION)


# --- shrinkage: what is noise, what follows depth, what is a layer's own ------------------------


def observe(
    log_ratio: Array, variance: float | Array, track: NDArray[np.int64], log_depth: Array, seed: int
) -> Observations:
    """Put every track at a place of its own in the image."""
    place = np.random.default_rng(seed).uniform(0, 1, (int(track.max(initial=0)) + 1, 2))
    spread = np.broadcast_to(np.asarray(variance, np.float64), log_ratio.shape).copy()
    return Observations(log_ratio, spread, track, log_depth, place[track])


def noisy_tracks(seed: int, sigma: float, num: int = 40) -> tuple[Observations, Array]:
    """Return observations of noise alone, and the noise."""
    rng = np.random.default_rng(seed)
    noise = sigma * rng.normal(size=num)
    log_depth = np.sort(rng.uniform(-1, 1.5, num))
    return observe(noise, sigma**2, np.arange(num), log_depth, seed), noise


def test_noise_alone_makes_no_curve_and_no_scales() -> None:
    found = [explain(noisy_tracks(seed, 0.02)[0], 40, with_curve=True) for seed in range(50)]
    silent = sum(distortion.strengths == (0.0, 0.0) for distortion in found)
    assert silent >= 46
    left = np.array([np.sqrt(np.mean(distortion.of_track**2)) for distortion in found])
    assert np.median(left) == 0
    assert left.max() < 0.02  # even then, less than the noise


def test_a_factor_that_follows_depth_is_found_as_a_curve() -> None:
    for seed in range(8):
        observed, noise = noisy_tracks(seed, 0.01)
        true = 0.15 * np.sin(2.0 * observed.log_depth)
        observed.log_ratio[:] = true + noise
        found = explain(observed, 40, with_curve=True)
        assert found.strengths[0] > 0.05
        assert (np.diff(found.knots) > 0).all()
        curve = np.interp(observed.log_depth, found.knots, found.curve)
        whole = curve + found.of_track
        assert np.sqrt(np.mean((whole - true) ** 2)) < 0.01
        assert np.sqrt(np.mean((curve - true) ** 2)) < 0.5 * np.sqrt(np.mean(true**2))


def test_without_a_curve_layers_still_get_what_depth_explains() -> None:
    observed, noise = noisy_tracks(0, 0.01)
    true = 0.15 * np.sin(2.0 * observed.log_depth)
    observed.log_ratio[:] = true + noise
    found = explain(observed, 40, with_curve=False)
    assert len(found.knots) == len(found.curve) == 0
    assert found.strengths[0] == 0
    assert np.sqrt(np.mean((found.of_track - true) ** 2)) < 0.02


def factors_of_tracks(seed: int) -> tuple[Distortion, Array, Observations]:
    """Explain 30 tracks with a factor of their own each, seen at 3 depths each."""
    rng = np.random.default_rng(seed)
    track = np.repeat(np.arange(30), 3)
    true = 0.12 * rng.normal(size=30)
    log_depth = rng.uniform(-1, 1.5, 30)[track] + np.tile([-0.2, 0.0, 0.2], 30)
    observed = observe(true[track] + 0.01 * rng.normal(size=90), 1e-4, track, log_depth, seed)
    return explain(observed, 30, with_curve=True), true, observed


def test_tracks_get_factors_of_their_own() -> None:
    for seed in range(8):
        found, true, observed = factors_of_tracks(seed)
        assert found.strengths[1] > 0.05
        curve = np.interp(observed.log_depth, found.knots, found.curve) if len(found.knots) else 0.0
        whole = np.asarray(curve + found.of_track[observed.track])
        assert np.sqrt(np.mean((whole - true[observed.track]) ** 2)) < 0.03


def test_the_less_certain_an_observation_the_less_it_is_followed() -> None:
    for seed in range(5):
        observed, noise = noisy_tracks(seed, 0.02)
        log_ratio = 0.1 * np.random.default_rng(seed + 99).normal(size=40) + noise
        variance = np.where(np.arange(40) % 2, 0.02**2, 0.5**2)
        mixed = observe(log_ratio, variance, observed.track, observed.log_depth, seed)
        found = explain(mixed, 40, with_curve=False)
        followed = np.abs(found.of_track / log_ratio)
        assert np.median(followed[1::2]) > 0.6
        assert np.median(followed[::2]) < 0.4


@pytest.mark.parametrize("num", [0, 1])
def test_less_than_two_observations_distort_nothing(num: int) -> None:
    track = np.arange(num)
    observed = observe(np.full(num, 0.3), 1e-4, track, np.zeros(num), 0)
    found = explain(observed, 5, with_curve=True)
    assert found.strengths == (0.0, 0.0)
    assert found.of_track.tolist() == [0.0] * 5
    assert len(found.knots) == 0


def test_observations_that_all_say_one_leave_everything_as_it_is() -> None:
    observed, _ = noisy_tracks(0, 0.02)
    observed.log_ratio[:] = 0
    found = explain(observed, 40, with_curve=True)
    assert (found.of_track == 0).all()
    assert len(found.knots) == 0


def test_tracks_without_observations_get_no_part() -> None:
    rng = np.random.default_rng(0)
    track = 2 * np.arange(30)
    log_ratio = 0.1 * rng.normal(size=30)
    observed = observe(log_ratio, 1e-4, track, rng.uniform(-1, 1, 30), 0)
    found = explain(observed, 61, with_curve=True)
    assert (found.of_track[1::2] == 0).all()
    assert (found.of_track[::2] != 0).any()


def test_hundreds_of_observations_are_as_good_as_the_strongest() -> None:
    """The weakest are left out for speed; here they are lies, and would bend the curve."""
    observed, noise = noisy_tracks(0, 0.01, 800)
    true = 0.15 * np.sin(2.0 * observed.log_depth)
    strong = np.arange(800) % 4 == 0
    log_ratio = np.where(strong, true, 0.5) + noise
    many = observe(log_ratio, np.where(strong, 1e-4, 1.0), observed.track, observed.log_depth, 0)
    found = explain(many, 800, with_curve=True)
    curve = np.interp(observed.log_depth, found.knots, found.curve)
    assert np.sqrt(np.mean((curve + found.of_track - true)[strong] ** 2)) < 0.02


def test_the_order_of_observations_does_not_matter() -> None:
    _, _, observed = factors_of_tracks(1)
    order = np.random.default_rng(5).permutation(90)
    shuffled = Observations(*(values[order] for values in vars(observed).values()))
    first = explain(observed, 30, with_curve=True)
    second = explain(shuffled, 30, with_curve=True)
    np.testing.assert_allclose(first.of_track, second.of_track, atol=1e-9)
    np.testing.assert_allclose(first.curve, second.curve, atol=1e-9)
