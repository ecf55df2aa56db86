"""The plane sweep: a known plane comes out, the compiled parts do what slow ones do, no unit."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.backbones.classical.confidence import choose_partners, confidence
from laser_slam.backbones.classical.confidence_kernels import ask
from laser_slam.backbones.classical.dense import PosedFrames, dense_depth, depth_size, plane_range
from laser_slam.backbones.classical.sweep import Sweep, View, choose_neighbours, make_view, sweep
from laser_slam.backbones.classical.sweep_kernels import (
    EDGE_WEIGHT,
    JUMP_FLOOR,
    JUMP_PENALTY,
    NO_VIEW_COST,
    STEP_PENALTY,
    aggregate_paths,
    census_transform,
    choose_winners,
    fill_volume,
    raise_motion,
)
from laser_slam.camera import intrinsics_matrix, project, rays
from laser_slam.config import ClassicalConfig
from laser_slam.sim3 import Array, rotation_exp

HEIGHT, WIDTH = 72, 112
K = intrinsics_matrix(100.0, 100.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
NORMAL, DISTANCE = np.array([-0.35, 0.15, 1.0]), 10.0  # the wall n . p = d, before all cameras
MIDDLE = 3


@dataclass(frozen=True)
class Wall:
    """A textured wall, seen from a row of cameras."""

    greys: list[NDArray[np.uint8]]
    rotations: Array  # cam_from_world
    translations: Array
    depths: list[Array]

    def views(self, unit: float = 1.0) -> list[View]:
        """Give the cameras, with lengths in so many metres."""
        frames = zip(self.greys, self.rotations, self.translations / unit, strict=True)
        return [make_view(*frame) for frame in frames]


def make_wall(step_m: float = 0.5, num: int = 7) -> Wall:
    rng = np.random.default_rng(0)
    texture = sum(
        s * cv2.GaussianBlur(rng.normal(size=(900, 1400)), (0, 0), float(s)) for s in (2, 4, 9)
    )
    texture = np.clip(128 + 45 * texture / np.std(texture), 0, 255).astype(np.float32)
    greys, rotations, translations, depths = [], [], [], []
    for n in range(num):
        centre = np.array([step_m, 0.1 * step_m, 0.3 * step_m]) * (n - num // 2)
        cam_from_world = rotation_exp(np.array([0.0, 0.01, 0.004]) * (n - num // 2))
        directions = rays(K, HEIGHT, WIDTH) @ cam_from_world
        depth = (DISTANCE - NORMAL @ centre) / (directions @ NORMAL)
        points = (centre + directions * depth[..., None]) * 60 + [700, 450, 0]
        x, y = points[..., 0].astype(np.float32), points[..., 1].astype(np.float32)
        greys.append(cv2.remap(texture, x, y, cv2.INTER_LINEAR).astype(np.uint8))
        rotations.append(cam_from_world)
        translations.append(-cam_from_world @ centre)
        depths.append(depth)
    return Wall(greys, np.stack(rotations), np.stack(translations), depths)


def sweep_all(
    wall: Wall, unit: float = 1.0, num_planes: int = 32
) -> tuple[list[View], list[Sweep]]:
    views = wall.views(unit)
    planes = np.linspace(unit / 4, unit / 25, num_planes, dtype=np.float32)
    pairs = [choose_neighbours(views, frame, 10 / unit) for frame in range(len(views))]
    return views, [sweep(views, frame, pairs[frame], planes, K) for frame in range(len(views))]


def rate(
    views: list[View],
    sweeps: Sequence[Sweep | None],
    frame: int = MIDDLE,
    median_depth: float = DISTANCE,
) -> NDArray[np.float32]:
    partners = choose_partners(views, frame, median_depth)
    return confidence(views, list(sweeps), frame, partners, K)


@pytest.fixture(scope="module")
def wall() -> Wall:
    return make_wall()


@pytest.fixture(scope="module")
def swept(wall: Wall) -> tuple[list[View], list[Sweep]]:
    return sweep_all(wall)


@pytest.mark.parametrize("frame", [0, MIDDLE, 6])
def test_a_slanted_wall_comes_out_where_it_is(
    wall: Wall, swept: tuple[list[View], list[Sweep]], frame: int
) -> None:
    """With a tenth of a plane's step of bias at most, for it lies between the planes."""
    relative = swept[1][frame].inverse_depth * wall.depths[frame] - 1
    inner = relative[8:-8, 12:-12]
    assert abs(np.median(inner)) < 0.005
    assert (np.abs(inner) < 0.05).mean() > 0.95
    assert np.quantile(np.abs(inner), 0.5) < 0.012


def test_a_confident_wall_is_a_right_one(wall: Wall, swept: tuple[list[View], list[Sweep]]) -> None:
    confidence = rate(*swept)
    relative = np.abs(swept[1][MIDDLE].inverse_depth * wall.depths[MIDDLE] - 1)
    assert confidence.min() >= 0
    assert confidence.max() <= 1
    assert (confidence > 0.5).mean() > 0.7
    assert (relative[confidence > 0.5] < 0.1).mean() > 0.98


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_the_unit_of_length_changes_nothing(
    wall: Wall, swept: tuple[list[View], list[Sweep]], unit: float
) -> None:
    """All but a few pixels: the sums of 32-bit numbers are rounded otherwise."""
    views, sweeps = sweep_all(wall, unit)
    same = np.isclose(
        sweeps[MIDDLE].inverse_depth / unit, swept[1][MIDDLE].inverse_depth, rtol=1e-3
    )
    assert same.mean() > 0.995
    scaled = rate(views, sweeps, median_depth=DISTANCE / unit)
    assert np.isclose(scaled, rate(*swept), atol=1e-3).mean() > 0.98


@pytest.mark.parametrize(("step_m", "least", "most"), [(0.5, 0.75, 1.0), (0.02, 0.0, 0.2)])
def test_confidence_needs_a_baseline(step_m: float, least: float, most: float) -> None:
    """At 2 cm before a wall at 10 m the next camera sees a fifth of a pixel of parallax."""
    views, sweeps = sweep_all(make_wall(step_m)) if step_m > 0.1 else _swept_blindly(step_m)
    assert least <= np.median(rate(views, sweeps)) <= most


def _swept_blindly(step_m: float) -> tuple[list[View], list[Sweep]]:
    """Sweep cameras so close together that no neighbour would be chosen."""
    views = make_wall(step_m).views()
    planes = np.linspace(1 / 4, 1 / 25, 32, dtype=np.float32)
    return views, [
        sweep(views, i, ([max(0, i - 1)], [min(6, i + 1)]), planes, K) for i in range(len(views))
    ]


def test_a_frame_whose_depth_is_another_lowers_the_confidence_of_its_neighbours(
    swept: tuple[list[View], list[Sweep]],
) -> None:
    views, sweeps = swept
    wrong = [
        s if i == MIDDLE else Sweep(
            np.float32(1.3) * s.inverse_depth, s.uniqueness, s.cost, s.pixels_per_unit, s.is_far
        )
        for i, s in enumerate(sweeps)
    ]  # fmt: skip
    assert np.quantile(rate(views, wrong), 0.95) < 0.05
    assert np.median(rate(views, sweeps)) > 0.5


def test_half_of_the_witnesses_are_too_few_for_trust(
    swept: tuple[list[View], list[Sweep]],
) -> None:
    views, sweeps = swept
    wrong = [
        Sweep(np.float32(1.3) * s.inverse_depth, s.uniqueness, s.cost, s.pixels_per_unit, s.is_far)
        if i in (0, 2, 5)
        else s
        for i, s in enumerate(sweeps)
    ]
    assert 0.1 < np.median(rate(views, wrong)) < 0.4
    assert np.median(rate(views, sweeps)) > 0.7


def test_frames_from_the_same_place_are_no_witnesses(
    swept: tuple[list[View], list[Sweep]],
) -> None:
    """A camera that stands makes the same error again and again; only where it moved counts."""
    order = [0, 1, 2, 3, 3, 3, 3, 3, 3, 3, 4, 5, 6]
    views, sweeps = [swept[0][i] for i in order], [swept[1][i] for i in order]
    assert np.median(rate(views, sweeps, 6)) > 0.5
    wrong = [
        Sweep(np.float32(1.3) * s.inverse_depth, s.uniqueness, s.cost, s.pixels_per_unit, s.is_far)
        if order[i] == 3
        else s
        for i, s in enumerate(sweeps)
    ]
    assert np.quantile(rate(views, wrong, 6), 0.95) < 0.05


def test_what_no_other_frame_was_asked_about_is_not_trusted(
    swept: tuple[list[View], list[Sweep]],
) -> None:
    views, sweeps = swept
    alone = [s if i == MIDDLE else None for i, s in enumerate(sweeps)]
    assert not rate(views, alone).any()


def test_the_sky_is_not_trusted_nor_its_seam_but_a_speck_takes_nothing_with_it(
    swept: tuple[list[View], list[Sweep]],
) -> None:
    views, sweeps = swept
    own = sweeps[MIDDLE]

    def rate_with(is_far: NDArray[np.bool_]) -> NDArray[np.float32]:
        sky = Sweep(own.inverse_depth, own.uniqueness, own.cost, own.pixels_per_unit, is_far)
        return rate(views, [sky if i == MIDDLE else s for i, s in enumerate(sweeps)])

    is_far = np.zeros((HEIGHT, WIDTH), bool)
    before = rate_with(is_far)
    is_far[20:50, 30:60] = True
    is_far[60, 90] = True
    after = rate_with(is_far)
    assert (before[18:52, 28:62] > 0).mean() > 0.9
    assert not after[18:52, 30:60].any()
    assert not after[is_far].any()
    far_off = np.ones_like(is_far)
    far_off[18:52, 28:62] = False
    far_off[60, 90] = False
    assert np.array_equal(after[far_off], before[far_off])


def test_agreement_is_a_matter_of_six_percent_or_of_a_fraction_of_a_pixel() -> None:
    """Two cameras in one place: what one sees, the other must see."""
    own = np.full((6, 9), 0.1, np.float32)
    mapping = np.column_stack([np.eye(3), np.zeros(3)])
    small_K = intrinsics_matrix(9.0, 9.0, 4.0, 2.5)
    for factor, pixels_per_unit, share in (
        (1.05, 1000, 1), (0.95, 1000, 1), (1.08, 1000, 0), (1.08, 50, 1), (1.2, 50, 0),
    ):  # fmt: skip
        agree, asked = np.zeros_like(own), np.zeros_like(own)
        motion = np.full_like(own, pixels_per_unit)
        ask(own, motion, np.float32(factor) * own, mapping, small_K, agree, asked)
        assert asked[:-1, :-1].all()
        assert np.array_equal(agree, share * asked)


def test_who_sees_a_pixel_from_nearer_must_see_it_nearer() -> None:
    """A wall 10 ahead, asked of a camera 2 further on: there it must be 8 ahead."""
    own, motion = np.full((7, 9), 0.1, np.float32), np.full((7, 9), 1e4, np.float32)
    forward = np.column_stack([np.eye(3), [0, 0, -2.0]])
    small_K = intrinsics_matrix(9.0, 9.0, 4.0, 3.0)
    for seen, expected in ((1 / 8, 1.0), (1 / 10, 0.0), (1 / 12, 0.0)):
        agree, asked = np.zeros_like(own), np.zeros_like(own)
        ask(own, motion, np.full_like(own, seen), forward, small_K, agree, asked)
        assert 20 < asked.sum() < own.size
        assert agree.sum() == expected * asked.sum()


def test_motion_is_that_in_the_neighbour_where_a_pixel_moves_most(
    wall: Wall, swept: tuple[list[View], list[Sweep]]
) -> None:
    """Move each pixel a little in inverse depth, and see how far it goes in each neighbour."""
    views, sweeps = swept
    inverse_depth, small = 1 / wall.depths[0], 1e-5
    moved = []
    for other in choose_neighbours(views, 0, 10.0)[1]:
        rotation = views[other].rotation @ views[0].rotation.T
        shift = views[other].translation - rotation @ views[0].translation
        at = [
            project(rays(K, HEIGHT, WIDTH) @ rotation.T + shift * w[..., None], K)
            for w in (inverse_depth - small, inverse_depth + small)
        ]
        moved.append(np.linalg.norm(at[1] - at[0], axis=-1) / (2 * small))
    assert np.median(moved[1] / moved[0]) > 1.8
    best = np.maximum(*moved)[8:-8, 12:-12]
    assert np.median(np.abs(sweeps[0].pixels_per_unit[8:-8, 12:-12] / best - 1)) < 0.01
    out = np.full((HEIGHT, WIDTH), 1e9, np.float32)
    raise_motion(np.column_stack([K, K @ shift]), sweeps[0].inverse_depth, out)
    assert (out == np.float32(1e9)).all()  # raised, never lowered


def test_census_has_a_bit_for_each_darker_neighbour() -> None:
    grey = np.random.default_rng(1).integers(0, 256, (9, 11), dtype=np.uint8)
    census = census_transform(grey)
    assert not census[:2].any()
    assert not census[:, -2:].any()
    offsets = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)]
    for y, x in ((2, 2), (4, 5), (6, 8)):
        bits = "".join(str(int(grey[y + i, x + j] < grey[y, x])) for i, j in offsets)
        assert census[y, x] == int(bits, 2)


def slow_volume(
    census: NDArray[np.uint32],
    sides: list[NDArray[np.uint32]],
    maps: list[Array],
    planes: NDArray[np.float32],
) -> Array:
    """Compare pixel by pixel and plane by plane, in plain numbers."""
    height, width = census.shape
    out = np.zeros((height, width, len(planes)))
    for i, j, d in np.ndindex(out.shape):
        means = []
        for others, mappings in zip(sides, maps, strict=True):
            bits = []
            for other, m in zip(others, mappings, strict=True):
                x, y, z = m[:, :3] @ [j, i, 1] + m[:, 3] * float(planes[d])
                x, y = int(np.floor(x / z + 0.5)), int(np.floor(y / z + 0.5))
                if z > 0 and 2 <= x < width - 2 and 2 <= y < height - 2:
                    bits.append(int(census[i, j] ^ other[y, x]).bit_count())
            if bits:
                means.append(sum(bits) / len(bits))
        if len(means) == 2:
            out[i, j, d] = 0.75 * min(means) + 0.25 * max(means)
        else:
            out[i, j, d] = means[0] if means else NO_VIEW_COST
    return np.floor(4 * out)


@pytest.mark.parametrize(("num_past", "num_future"), [(2, 2), (1, 2), (0, 2), (1, 0)])
def test_the_cost_volume_is_that_of_a_slow_one(num_past: int, num_future: int) -> None:
    """Patterns of noise and mappings that are no camera's: nothing may depend on the content."""
    rng = np.random.default_rng(2)
    census = rng.integers(0, 2**24, (13, 17), dtype=np.uint32)
    planes = np.linspace(0.25, 0.05, 16, dtype=np.float32)
    sides, maps = [], []
    for num in (num_past, num_future):
        sides.append(rng.integers(0, 2**24, (num, 13, 17), dtype=np.uint32))
        near_identity = np.column_stack([np.eye(3), np.zeros(3)])
        noise = rng.normal(size=(num, 3, 4)) * [[0.05, 0.05, 1, 30], [0.05, 0.05, 1, 20], [0] * 4]
        noise[:, 2] = rng.normal(size=(num, 4)) * [0, 0, 0, 2.5]  # some planes end up behind
        maps.append(near_identity + noise)
    volume = np.zeros((13, 17, 16), np.uint8)
    fill_volume(census, sides[0], sides[1], maps[0], maps[1], planes, volume)
    expected = slow_volume(census, sides, maps, planes)
    assert (volume == expected).mean() > 0.995  # rounding may choose the pixel beside
    assert len(np.unique(volume)) > 12


def slow_path(costs: Array, greys: NDArray[np.uint8]) -> Array:
    """Extend one path over (N, D) costs, as the paper of semi-global matching has it."""
    out = np.zeros_like(costs)
    out[0] = costs[0]
    for n in range(1, len(costs)):
        contrast = abs(float(greys[n]) - float(greys[n - 1]))
        jump = max(float(JUMP_FLOOR), float(JUMP_PENALTY) / (1 + float(EDGE_WEIGHT) * contrast))
        for d in range(costs.shape[1]):
            ways = [out[n - 1, d], out[n - 1].min() + jump]
            ways += [out[n - 1, k] + STEP_PENALTY for k in (d - 1, d + 1) if 0 <= k < len(out[0])]
            out[n, d] = costs[n, d] + min(ways) - out[n - 1].min()
    return out


def test_the_paths_are_those_of_slow_semi_global_matching() -> None:
    rng = np.random.default_rng(3)
    volume = rng.integers(0, 97, (6, 8, 12), dtype=np.uint8)
    volume[2:4] = np.minimum(volume[2:4], 4 * np.abs(np.arange(12) - 7))  # all agree on a plane
    grey = rng.integers(0, 256, (6, 8), dtype=np.uint8)
    grey[:, 4:] = grey[0, 4]  # no edges there
    total = np.zeros(volume.shape, np.float32)
    aggregate_paths(volume, grey, total)
    costs, expected = volume / 4.0, np.zeros(volume.shape)
    for i in range(6):
        expected[i] += slow_path(costs[i], grey[i])
        expected[i] += slow_path(costs[i, ::-1], grey[i, ::-1])[::-1]
    for j in range(8):
        expected[:, j] += slow_path(costs[:, j], grey[:, j])
        expected[:, j] += slow_path(costs[::-1, j], grey[::-1, j])[::-1]
    np.testing.assert_allclose(total, expected, atol=1e-3)


def test_winners_lie_on_the_parabola_through_the_best_three() -> None:
    planes = np.linspace(1.0, 0.1, 19, dtype=np.float32)
    step = planes[0] - planes[1]
    true = np.array([[3.0, 5.25, 9.7], [12.4, 0.2, 18.4]])
    total = ((np.arange(19) - true[..., None]) ** 2).astype(np.float32)
    volume = np.full(total.shape, 20, np.uint8)
    volume[0, 1, 5] = 8
    inverse_depth, uniqueness, cost, is_far = choose_winners(total, volume, planes)
    expected = planes[0] - step * true
    expected[1, 1:] = planes[[0, 18]]  # no parabola at the ends
    np.testing.assert_allclose(inverse_depth, expected, atol=1e-6)
    np.testing.assert_allclose(cost, [[5, 2, 5], [5, 5, 5]])
    np.testing.assert_array_equal(is_far, [[False] * 3, [False, False, True]])
    # The best plane at least three away from 3.0 costs 9 more, from 5.25 (5): 2.75^2 - 0.25^2.
    np.testing.assert_allclose(uniqueness[0, :2], [9.0, 7.5], atol=1e-5)


def test_equal_costs_have_a_winner_and_no_uniqueness() -> None:
    planes = np.linspace(1.0, 0.1, 16, dtype=np.float32)
    flat = np.ones((2, 3, 16), np.float32)
    inverse_depth, uniqueness, _, _ = choose_winners(flat, np.zeros(flat.shape, np.uint8), planes)
    assert np.isfinite(inverse_depth).all()
    assert not uniqueness.any()


def row_of_cameras(places: NDArray[np.floating]) -> list[View]:
    empty = np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.uint32)
    return [View(*empty, np.eye(3), np.array([0.0, 0.0, -place])) for place in places]


def test_neighbours_go_by_baseline_and_not_by_index() -> None:
    """Wanted are 0.05 and 0.1 of the median depth, here 0.5 and 1 of 10."""
    slow, fast = row_of_cameras(0.1 * np.arange(30)), row_of_cameras(2.0 * np.arange(30))
    assert choose_neighbours(slow, 15, 10.0) == ([10, 5], [20, 25])
    assert choose_neighbours(fast, 15, 10.0) == ([14, 13], [16, 17])
    assert choose_neighbours(fast, 15, 40.0) == ([14, 13], [16, 17])
    assert choose_neighbours(slow, 15, 1.0) == ([14, 13], [16, 17])


def test_the_ends_use_the_one_side_that_there_is() -> None:
    cameras = row_of_cameras(0.5 * np.arange(6))
    assert choose_neighbours(cameras, 0, 10.0) == ([], [1, 2])
    assert choose_neighbours(cameras, 5, 10.0) == ([4, 3], [])


def test_a_camera_that_stands_takes_its_neighbours_from_when_it_moved() -> None:
    stop_and_go = row_of_cameras(np.array([0, 0.5, 1, 1.001, 1.002, 1.003, 1.5, 2]))
    assert choose_neighbours(stop_and_go, 4, 10.0) == ([1, 0], [6, 7])
    assert choose_neighbours(row_of_cameras(np.zeros(5)), 2, 10.0) == ([], [])


def test_a_few_false_points_before_the_lens_do_not_take_the_planes_with_them() -> None:
    depths = np.random.default_rng(4).uniform(5, 60, 500)
    false = np.concatenate([depths, np.full(10, 0.01)])
    assert 1 / plane_range(false, 64)[0] > 0.5 / plane_range(depths, 64)[0]


def test_planes_hold_the_sparse_depths_well_inside_at_equal_steps_of_inverse_depth() -> None:
    depths = np.random.default_rng(4).uniform(5, 60, 500)
    planes = plane_range(depths, 64)
    assert planes.shape == (64,)
    assert 1 / planes[0] < 0.7 * 5
    assert 1 / planes[-1] > 2 * 60
    np.testing.assert_allclose(np.diff(planes), np.diff(planes)[0], rtol=1e-3)
    np.testing.assert_allclose(plane_range(100 * depths, 64), planes / 100, rtol=1e-4)


def test_a_few_points_at_infinity_do_not_take_the_planes_with_them() -> None:
    depths = np.concatenate([np.linspace(5, 15, 90), np.full(10, 1e6)])
    planes = plane_range(depths, 64)
    assert 1 / planes[-1] == pytest.approx(20 * np.median(depths), rel=1e-3)
    one_depth = plane_range(np.full(50, 8.0), 16)
    assert (np.diff(one_depth) < 0).all()


@pytest.mark.parametrize(
    ("size", "width", "expected"),
    [((376, 1241), 640, (194, 640)), ((90, 160), 640, (90, 160)), ((641, 333), 320, (616, 320))],
)
def test_depth_maps_are_no_larger_than_asked_nor_than_the_image(
    size: tuple[int, int], width: int, expected: tuple[int, int]
) -> None:
    assert depth_size(size, width) == expected


def dense(
    wall: Wall, sparse: list[Array], unit: float = 1.0, wanted: tuple[int, ...] = tuple(range(7))
) -> tuple[NDArray[np.float32], NDArray[np.float32], Array]:
    frames = PosedFrames(wall.greys, wall.rotations, wall.translations / unit, sparse, K)
    with ThreadPoolExecutor(2) as workers:
        return dense_depth(frames, list(wanted), ClassicalConfig(num_planes=32), workers)


def sparse_depths(wall: Wall, unit: float = 1.0) -> list[Array]:
    return [depth[::5, ::5].ravel() / unit for depth in wall.depths]


def test_depth_is_unknown_where_there_is_no_confidence(wall: Wall) -> None:
    depth, confidence, depth_K = dense(wall, sparse_depths(wall))
    assert depth.shape == confidence.shape == (7, HEIGHT, WIDTH)
    assert np.array_equal(np.isnan(depth), confidence == 0)
    assert (confidence[MIDDLE] > 0.5).mean() > 0.7
    np.testing.assert_allclose(depth_K, K)
    relative = depth / np.stack(wall.depths) - 1
    assert abs(np.nanmedian(relative)) < 0.005
    assert (np.abs(relative)[confidence > 0.5] < 0.1).mean() > 0.97


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_dense_depth_scales_with_the_unit_and_confidence_does_not(wall: Wall, unit: float) -> None:
    depth, confidence, _ = dense(wall, sparse_depths(wall))
    scaled, same, _ = dense(wall, sparse_depths(wall, unit), unit)
    both = (confidence > 0) & (same > 0)
    assert both.sum() > 0.98 * (confidence > 0).sum()
    assert np.isclose(scaled[both] * unit, depth[both], rtol=1e-3).mean() > 0.99
    assert np.isclose(same, confidence, atol=1e-3).mean() > 0.97


def test_a_frame_without_sparse_points_has_no_depth_and_spoils_no_other(wall: Wall) -> None:
    sparse = sparse_depths(wall)
    sparse[2] = sparse[2][:4]
    depth, confidence, _ = dense(wall, sparse)
    assert np.isnan(depth[2]).all()
    assert not confidence[2].any()
    assert (confidence[MIDDLE] > 0.5).mean() > 0.6


def test_frames_that_are_not_wanted_serve_as_neighbours_only(wall: Wall) -> None:
    depth, confidence, _ = dense(wall, sparse_depths(wall), wanted=(3, 4, 5))
    assert depth.shape == (3, HEIGHT, WIDTH)
    relative = np.abs(depth / np.stack(wall.depths[3:6]) - 1)
    assert (confidence > 0.5).mean() > 0.4
    assert (relative[confidence > 0.5] < 0.1).mean() > 0.97


def test_a_camera_that_never_moves_has_no_depth(wall: Wall) -> None:
    still = Wall(
        [wall.greys[0]] * 4, wall.rotations[[0] * 4], wall.translations[[0] * 4], wall.depths[:4]
    )
    depth, confidence, _ = dense(still, sparse_depths(still), wanted=(0, 1, 2, 3))
    assert np.isnan(depth).all()
    assert not confidence.any()
