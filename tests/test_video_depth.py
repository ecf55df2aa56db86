"""Video depth is scored as the published protocol does, of any length, and None where unknown."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.evaluation import (
    VIDEO_DEPTH_PROTOCOLS,
    VideoDepthErrors,
    VideoDepthProtocol,
    evaluate_video_depth,
    resize_depth,
    video_depth,
)

Depth = NDArray[np.float32]
DATA = os.environ.get("LASER_SLAM_DATA")
SINTEL, KITTI = VIDEO_DEPTH_PROTOCOLS["sintel"], VIDEO_DEPTH_PROTOCOLS["kitti"]


def noisy_video(seed: int = 0, num: int = 4, unit: float = 0.2) -> list[tuple[Depth, Depth]]:
    """Make depth of another unit with 10 % noise, a fifth of it far too deep."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1, 100, (num, 20, 30)).astype(np.float32)
    ratio = np.exp(0.1 * rng.normal(size=truth.shape)) * np.where(
        rng.random(truth.shape) < 0.2, 3, 1
    )
    return list(zip((unit * ratio * truth).astype(np.float32), truth, strict=True))


def score(
    pairs: list[tuple[Any, Depth]], protocol: VideoDepthProtocol = KITTI, **options: Any
) -> VideoDepthErrors:
    return evaluate_video_depth(lambda: iter(pairs), protocol, **options)


def slow_score(
    pairs: list[tuple[Depth, Depth]], protocol: VideoDepthProtocol, scale: float | None = None
) -> tuple[float, float, float]:
    """Follow the published procedure literally, pixel by pixel of the whole video at once.

    Its scale is found where none is given.
    """
    cap = np.inf if protocol.max_depth_m is None else protocol.max_depth_m
    values = [
        (p, g)
        for depth, truth in pairs
        for p, g in zip(depth.ravel().tolist(), truth.ravel().tolist(), strict=True)
        if 0 < g < cap
    ]
    p, g = np.array(values).T
    if scale is None:
        scale = float(np.nanmean(g) / np.nanmean(p))
        for _ in range(10):
            weights = 1 / (np.abs(scale * p - g) + 1e-8)
            scale = float(np.sum(weights * p * g) / np.sum(weights * p**2))
    p = scale * p if protocol.clip_m is None else np.clip(scale * p, None, protocol.clip_m)
    ratio = np.maximum(p / g, g / p)
    return float(np.mean(np.abs(p - g) / g)), float(np.mean(ratio < 1.25)), scale


@pytest.mark.parametrize("name", ["sintel", "bonn", "kitti"])
def test_scores_agree_with_the_published_procedure(name: str) -> None:
    protocol = VIDEO_DEPTH_PROTOCOLS[name]
    for seed in range(3):
        pairs = noisy_video(seed)
        mine = score(pairs, protocol)
        theirs = slow_score(pairs, protocol)
        assert (mine.abs_rel, mine.delta_125, mine.scale) == pytest.approx(theirs, abs=1e-6)


def test_the_unit_of_depth_changes_no_score() -> None:
    plain = score(noisy_video(unit=1.0), SINTEL)
    assert plain.scale is not None
    for unit in (1 / 64, 64.0):  # exact in floating point, so that nothing is rounded otherwise
        other = score(noisy_video(unit=unit), SINTEL)
        assert other.abs_rel == pytest.approx(plain.abs_rel, abs=1e-12)
        assert other.delta_125 == plain.delta_125
        assert other.scale == pytest.approx(plain.scale / unit, rel=1e-12)


def test_perfect_depth_has_no_error_in_any_unit() -> None:
    truth = [pair[1] for pair in noisy_video()]
    for unit in (0.01, 1.0, 100.0):
        errors = score([(unit * each, each) for each in truth], SINTEL)
        assert errors.abs_rel == pytest.approx(0, abs=1e-6)
        assert errors.delta_125 == 1
        assert errors.scale == pytest.approx(1 / unit, rel=1e-6)
        assert errors.coverage == 1


def test_the_order_of_frames_and_pixels_does_not_matter() -> None:
    pairs = noisy_video()
    mixed = [(depth[::-1], truth[::-1]) for depth, truth in reversed(pairs)]
    assert score(mixed).abs_rel == pytest.approx(score(pairs).abs_rel, abs=1e-6)
    assert score(mixed).scale == pytest.approx(score(pairs).scale, rel=1e-6)


def test_one_scale_serves_the_whole_video() -> None:
    """Frames that are right each on its own, but of two scales, are not right together."""
    truth = np.full((10, 10), 5.0, dtype=np.float32)
    pairs = [(truth, truth)] * 3 + [(2 * truth, truth)]
    errors = score(pairs)
    assert errors.scale == pytest.approx(1, abs=0.01)
    assert errors.abs_rel == pytest.approx(0.25, abs=0.01)
    assert errors.delta_125 == 0.75


def test_ten_steps_come_near_the_least_absolute_error_and_do_not_reach_it() -> None:
    """The least is at the median of truth / depth weighted with depth; the protocol stops before.

    A pixel whose error happens to be tiny weighs as much as a million others for one step, so that
    the rounding of the sums shows in the sixth digit: no tolerance here can be finer.
    """
    pairs = noisy_video()
    found, true = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in (0, 1))
    order = np.argsort(true / found)
    cumulated = np.cumsum(found[order])
    best = float((true / found)[order][np.searchsorted(cumulated, cumulated[-1] / 2)])
    start = true.sum() / found.sum()
    scale = score(pairs).scale
    assert scale is not None
    assert start < scale < best
    errors = [float(np.abs(each * found - true).sum()) for each in (start, scale, best)]
    assert errors[1] < 1.02 * errors[2]
    assert errors[0] > 1.04 * errors[2]


def test_a_long_video_is_read_again_and_scored_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs, reads = noisy_video(), []

    def read() -> Iterator[tuple[Depth, Depth]]:
        reads.append(1)
        yield from pairs

    short = evaluate_video_depth(read, SINTEL)
    assert len(reads) == 1
    monkeypatch.setattr(video_depth, "_MEMORY_PIXELS", 700)
    assert evaluate_video_depth(read, SINTEL) == short
    assert len(reads) == 1 + 13  # counts, the ratio of means, ten steps, the errors


def test_pixels_beyond_the_cap_are_not_compared() -> None:
    truth = np.array([[10.0, 20.0, 69.9, 70.0, 500.0]], dtype=np.float32)
    depth = np.array([[10.0, 20.0, 69.9, 1.0, 1.0]], dtype=np.float32)
    assert score([(depth, truth)], SINTEL, alignment="metric").abs_rel == 0
    assert score([(depth, truth)], SINTEL).num_pixels == 3
    assert score([(depth, truth)], SINTEL).coverage == 1
    assert score([(depth, truth)], KITTI).num_pixels == 5


def test_scaled_depth_is_cut_off_only_where_the_protocol_says() -> None:
    truth = np.full((1, 2), 50.0, dtype=np.float32)
    depth = np.array([[50.0, 500.0]], dtype=np.float32)
    cut = score([(depth, truth)], SINTEL, alignment="metric")
    uncut = score([(depth, truth)], VIDEO_DEPTH_PROTOCOLS["bonn"], alignment="metric")
    assert cut.abs_rel == pytest.approx((0 + 20 / 50) / 2)
    assert uncut.abs_rel == pytest.approx((0 + 450 / 50) / 2)


def test_unknown_pixels_are_left_out_and_counted() -> None:
    truth = np.full((4, 5), 3.0, dtype=np.float32)
    truth[0] = [np.nan, 0, -1, np.inf, 3]
    depth = np.full((4, 5), 2.0, dtype=np.float32)
    depth[1, :4] = [np.nan, 0, -1, np.inf]
    errors = score([(depth, truth), (None, truth)])
    assert errors.num_pixels == 12
    assert errors.num_frames == 2
    assert errors.num_predicted == 1
    assert errors.num_true_pixels == 32
    assert errors.coverage == pytest.approx(12 / 32)
    assert errors.abs_rel == pytest.approx(0, abs=1e-7)


def test_nothing_to_compare_is_none_with_a_reason() -> None:
    some = np.ones((2, 3), dtype=np.float32)
    unknown = np.full((2, 3), np.nan, dtype=np.float32)
    for pairs, coverage, reason in (
        ([], None, "no pixel has truth"),
        ([(some, unknown)], None, "no pixel has truth"),
        ([(unknown, some), (None, some)], 0, "no pixel has both depth and truth"),
    ):
        errors = score(pairs)
        assert (errors.abs_rel, errors.delta_125, errors.scale) == (None, None, None)
        assert (errors.num_pixels, errors.coverage, errors.reason) == (0, coverage, reason)


def test_depth_is_resized_as_the_protocol_does() -> None:
    depth = np.random.default_rng(0).uniform(1, 2, (20, 30)).astype(np.float32)
    cubic = cv2.resize(depth, (75, 64), interpolation=cv2.INTER_CUBIC)
    np.testing.assert_array_equal(resize_depth(depth, (64, 75)), cubic)
    assert resize_depth(depth, (20, 30)) is depth
    half = resize_depth(depth.astype(np.float16), (64, 75))
    np.testing.assert_allclose(half, cubic, rtol=2e-3)


def test_an_unknown_pixel_stays_one_pixel_when_resized() -> None:
    depth = np.ones((10, 10), dtype=np.float32)
    depth[4, 6] = np.nan
    large = resize_depth(depth, (40, 40))
    np.testing.assert_array_equal(np.argwhere(np.isnan(large)).min(axis=0), [16, 24])
    assert np.isnan(large).sum() == 16


def test_a_cubic_never_turns_near_depth_negative() -> None:
    depth = np.where(np.arange(20) < 10, 0.01, 50.0).astype(np.float32)[None].repeat(4, axis=0)
    assert cv2.resize(depth, (70, 14), interpolation=cv2.INTER_CUBIC).min() < 0
    assert resize_depth(depth, (14, 70)).min() > 0


@pytest.mark.skipif(DATA is None, reason="LASER_SLAM_DATA does not name the data folder")
def test_a_real_room_is_scored_as_published() -> None:
    """Depth of the kitchen at a third of its unit, at network size, with 3 % noise."""
    room = SevenScenes(Path(str(DATA)) / "7scenes/kitchen/seq-01")
    rng = np.random.default_rng(0)
    pairs = []
    for frame in (0, 60, 120):
        truth = room.true_depth(frame)
        assert truth is not None
        shallow = np.where(np.isfinite(truth), truth, np.float32(1.0)) / 3
        shallow *= np.exp(0.03 * rng.normal(size=truth.shape)).astype(np.float32)
        pairs.append((cv2.resize(shallow, (518, 392), interpolation=cv2.INTER_AREA), truth))
    mine = score(pairs, VIDEO_DEPTH_PROTOCOLS["bonn"])
    resized = [
        (cv2.resize(depth, truth.shape[::-1], interpolation=cv2.INTER_CUBIC), truth)
        for depth, truth in pairs
    ]
    theirs = slow_score(resized, VIDEO_DEPTH_PROTOCOLS["bonn"])
    # The order of the sums alone moves the scale by 7e-5 here: see above.
    assert mine.scale == pytest.approx(theirs[2], rel=1e-4)
    assert mine.abs_rel == pytest.approx(theirs[0], rel=5e-4)  # and what follows from it
    with_mine = slow_score(resized, VIDEO_DEPTH_PROTOCOLS["bonn"], mine.scale)
    assert mine.abs_rel == pytest.approx(with_mine[0], abs=1e-6)
    assert mine.delta_125 == pytest.approx(with_mine[1], abs=3 / mine.num_pixels)
    assert mine.scale == pytest.approx(3, rel=0.01)
    assert mine.coverage == 1
