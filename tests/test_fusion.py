"""Submaps become one cloud: every pixel counted once, no veils, memory bounded by the map."""

import weakref
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from submaps import EVERYTHING, SIZE, submap_of, wavy_depth

from laser_slam.camera import intrinsics_from_fov, rays, unproject
from laser_slam.config import FusionConfig
from laser_slam.fusion import fuse
from laser_slam.fusion.grid import VoxelGrid
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Cloud, Prediction, Submap

SHARP = FusionConfig(voxel_size=1e-3, min_observations=1, tile_bits=12)


def flat_submap(depth: np.ndarray) -> Submap:
    """Make a submap of one frame at the origin, confident everywhere it is known."""
    known = np.isfinite(depth)[None]
    return Submap(
        index=0,
        prediction=Prediction(
            frames=np.arange(1),
            depth=depth[None].astype(np.float32),
            confidence=known.astype(np.float32),
            window_from_cam=np.eye(4)[None],
            intrinsics=intrinsics_from_fov(70, *depth.shape)[None],
        ),
        colors=np.full((1, *depth.shape, 3), 100, np.uint8),
        world_from_window=Sim3(),
        is_owned=np.ones(1, dtype=bool),
        registration=None,
    )


def slow_fuse(submaps: list[Submap], config: FusionConfig) -> dict[tuple[int, ...], np.ndarray]:
    """Average voxel by voxel in a dictionary: weight, position, colour."""
    sums: dict[tuple[int, ...], np.ndarray] = defaultdict(lambda: np.zeros(7))
    for submap in submaps:
        prediction, step = submap.prediction, config.stride
        world_from_cam = submap.world_from_window.matrix() @ prediction.window_from_cam
        for i in np.flatnonzero(submap.is_owned):
            local = unproject(prediction.depth[i], prediction.intrinsics[i])
            world = local @ world_from_cam[i, :3, :3].T + world_from_cam[i, :3, 3]
            confidence = prediction.confidence[i]
            used = np.isfinite(prediction.depth[i]) & (confidence >= config.min_confidence)
            for v, u in np.argwhere(used & (confidence > 0)):
                if v % step == 0 and u % step == 0:
                    key = tuple(np.floor(world[v, u] / config.voxel_size).astype(int))
                    value = np.concatenate([[1.0], world[v, u], submap.colors[i, v, u]])
                    sums[key] += confidence[v, u] * value
    return sums


def voxels_of(cloud: Cloud) -> dict[tuple[int, ...], int]:
    keys = np.floor(cloud.points / cloud.voxel_size).astype(int)
    return {tuple(key): row for row, key in enumerate(keys)}


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("min_confidence", [0.0, 0.6])
def test_the_hash_grid_agrees_with_a_dictionary(stride: int, min_confidence: float) -> None:
    changes = {"stride": stride, "min_confidence": min_confidence}
    config = EVERYTHING.model_copy(update=changes)
    submaps = [submap_of(wavy_depth(seed=i), index=i, seed=i) for i in range(3)]
    submaps[1] = replace(submaps[1], is_owned=np.array([False, True, True]))
    slow = slow_fuse(submaps, config)
    cloud = fuse(submaps, config)
    assert len(cloud.points) == len(slow) > 50
    expected = np.array(list(slow.values()))
    expected[:, 1:] /= expected[:, :1]
    nearest = np.linalg.norm(cloud.points[:, None] - expected[None, :, 1:4], axis=2)
    match = nearest.argmin(axis=1)
    assert len(set(match)) == len(match)
    np.testing.assert_allclose(cloud.points, expected[match, 1:4], atol=1e-6)
    np.testing.assert_allclose(cloud.weights, expected[match, 0], rtol=1e-5)
    np.testing.assert_allclose(cloud.colors, expected[match, 4:], atol=0.51)


def test_support_counts_the_views_of_a_voxel_and_its_neighbours() -> None:
    submaps = [submap_of(wavy_depth(seed=i, holes=0.6), index=i, seed=i) for i in range(3)]
    config = EVERYTHING.model_copy(update={"voxel_size": 0.15})
    views: dict[tuple[int, ...], int] = defaultdict(int)
    for submap in submaps:
        for i in range(3):
            single = replace(submap, is_owned=np.arange(3) == i)
            for key in slow_fuse([single], config):
                views[key] += 1
    offsets = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    for least in (2, 5, 9):
        expected = {
            key
            for key in list(views)
            if sum(views.get((key[0] + x, key[1] + y, key[2] + z), 0) for x, y, z in offsets)
            >= least
        }
        cloud = fuse(submaps, config.model_copy(update={"min_observations": least}))
        assert set(voxels_of(cloud)) == expected
        assert expected < set(views)


def test_frames_of_the_overlap_are_not_doubled() -> None:
    first, second = submap_of(wavy_depth(4)), submap_of(wavy_depth(4), index=1)
    shared = replace(second, is_owned=np.array([False, False, True, True]))
    whole = fuse(
        [replace(first, is_owned=np.array([True, True, False, False])), shared], EVERYTHING
    )
    once = fuse([first], EVERYTHING)
    np.testing.assert_allclose(whole.weights.sum(), once.weights.sum(), rtol=1e-5)
    np.testing.assert_allclose(whole.points, once.points, atol=1e-6)


def test_each_frame_goes_where_its_own_place_says() -> None:
    """Closures have bent the chain: the frames of one window differ in turn, move and scale."""
    submap, rng = submap_of(wavy_depth(4)), np.random.default_rng(3)
    places = tuple(
        Sim3(1 + 0.3 * rng.random(), rotation_exp(0.3 * rng.normal(size=3)), rng.normal(size=3))
        @ submap.world_from_window
        for _ in range(4)
    )
    bent = fuse([replace(submap, places=places)], EVERYTHING)
    one_by_one = [
        replace(submap, world_from_window=place, is_owned=np.arange(4) == i)
        for i, place in enumerate(places)
    ]
    expected = fuse(one_by_one, EVERYTHING)
    np.testing.assert_array_equal(bent.points, expected.points)
    assert len(bent.points) != len(fuse([submap], EVERYTHING).points)


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_the_unit_of_the_windows_changes_nothing(unit: float) -> None:
    config = FusionConfig(min_confidence=0.3, min_observations=2, max_range=1.3)
    depths = [wavy_depth(seed=i) for i in range(2)]
    cloud = fuse((submap_of(d, seed=i) for i, d in enumerate(depths)), config)
    other = fuse((submap_of(d, seed=i, unit=unit) for i, d in enumerate(depths)), config)
    assert other.voxel_size == pytest.approx(cloud.voxel_size, rel=1e-5)
    assert len(other.points) == pytest.approx(len(cloud.points), rel=0.005)  # rounding at borders
    assert other.weights.sum() == pytest.approx(cloud.weights.sum(), rel=0.005)
    np.testing.assert_allclose(other.points.mean(0), cloud.points.mean(0), atol=0.005)


def test_the_unit_of_the_world_scales_the_cloud() -> None:
    config = FusionConfig(min_confidence=0.3, min_observations=2)
    submap = submap_of(wavy_depth())
    larger = replace(submap, world_from_window=Sim3(4.0) @ submap.world_from_window)
    cloud, other = fuse([submap], config), fuse([larger], config)
    assert other.voxel_size == 4 * cloud.voxel_size
    np.testing.assert_allclose(other.points, 4 * cloud.points, atol=1e-6)


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_a_wall_stays_in_the_map_whatever_pixels_are_used(stride: int) -> None:
    wall = np.full((12, *SIZE), 5.0, np.float32)
    submap = submap_of(wall)
    aside = np.tile(np.eye(4), (12, 1, 1))
    aside[:, 0, 3] = np.random.default_rng(1).normal(size=12)
    prediction = replace(
        submap.prediction, window_from_cam=aside, confidence=np.ones_like(wall, np.float32)
    )
    config = FusionConfig(stride=stride, min_observations=10)
    cloud = fuse([replace(submap, prediction=prediction)], config)
    width_m = 5.0 * SIZE[1] / submap.prediction.intrinsics[0, 0, 0] * submap.world_from_window.scale
    spread = np.ptp(cloud.points, axis=0).max()
    assert spread > 0.8 * width_m


def test_both_sides_of_a_depth_edge_stay_out() -> None:
    depth = np.full(SIZE, 5.0, np.float32)
    depth[:, 20:] = 2.0
    cloud = fuse([flat_submap(depth)], SHARP)
    assert len(cloud.points) == SIZE[0] * (SIZE[1] - 2)
    assert set(np.round(cloud.points[:, 2], 3)) == {2.0, 5.0}


def test_a_smeared_edge_leaves_no_veil() -> None:
    depth = np.full(SIZE, 10.0, np.float32)
    depth[:, 20:] = 2.0
    depth[:, 19:22] = [7.0, 4.5, 2.5]
    cloud = fuse([flat_submap(depth)], SHARP)
    assert set(np.round(cloud.points[:, 2], 3)) == {2.0, 10.0}


def test_a_road_seen_at_a_grazing_angle_has_no_edges() -> None:
    intrinsics = intrinsics_from_fov(70, 96, 320)
    down = rays(intrinsics, 96, 320)[..., 1]
    with np.errstate(divide="ignore"):
        depth = np.where(down > 0, 1.65 / down, np.nan).astype(np.float32)
    depth[depth > 25] = np.nan  # neighbouring rows are 11 % apart there
    config = SHARP.model_copy(update={"max_range": 100})
    cloud = fuse([flat_submap(depth)], config)
    outermost = 2 * 320  # the first and the last row have no neighbour that proves a plane
    assert len(cloud.points) >= np.isfinite(depth).sum() - outermost
    np.testing.assert_allclose(cloud.points[:, 1], 1.65, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_normals_are_those_of_the_surface_and_face_the_camera(seed: int) -> None:
    """A wall at any slant, in a window that is turned anyhow; single pixels have no neighbours."""
    rng = np.random.default_rng(seed)
    normal = np.array([*rng.uniform(-0.6, 0.6, 2), -1.0])
    normal /= np.linalg.norm(normal)
    depth = 3.0 / (rays(intrinsics_from_fov(70, *SIZE), *SIZE) @ -normal)
    holes = rng.random(SIZE) < 0.3
    submap = flat_submap(np.where(holes, np.nan, depth).astype(np.float32))
    turn = rotation_exp(rng.normal(size=3))
    cloud = fuse([replace(submap, world_from_window=Sim3(2.0, turn, rng.normal(size=3)))], SHARP)
    assert cloud.normals is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)
    assert np.median(cloud.normals @ (turn @ normal)) > np.cos(np.radians(1))
    assert (cloud.normals @ (turn @ normal)).min() > 0  # at worst the ray's direction


def test_points_beyond_the_range_stay_out() -> None:
    depth = np.full(SIZE, 1.0, np.float32)
    depth[:, 30:] = 3.5
    config = SHARP.model_copy(update={"max_range": 3})
    assert fuse([flat_submap(depth)], config).points[:, 2].max() == pytest.approx(1.0)


def test_averages_lose_nothing_far_from_the_origin() -> None:
    submap = flat_submap(np.full(SIZE, 2.0, np.float32))
    far = replace(submap, world_from_window=Sim3(translation=np.array([40_000.0, 0, -30_000.0])))
    config = FusionConfig(voxel_size=0.1, min_observations=1)
    near_mean = np.average(fuse([submap], config).points, axis=0)
    shifted = fuse([far], config).points - [40_000.0, 0, -30_000.0]
    np.testing.assert_allclose(np.average(shifted, axis=0), near_mean, atol=1e-6)


def test_points_out_of_reach_stay_out_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    submap = flat_submap(np.full(SIZE, 2.0, np.float32))
    far = replace(submap, world_from_window=Sim3(translation=np.array([2e6, 0, 0])))
    cloud = fuse([submap, far], FusionConfig(voxel_size=0.01, min_observations=1))
    assert cloud.points[:, 0].max() < 10
    assert "raise fusion.voxel_size" in caplog.text


def test_nothing_confident_is_an_empty_cloud() -> None:
    for submaps in ([], [submap_of(np.full((2, *SIZE), np.nan, np.float32))]):
        cloud = fuse(submaps, FusionConfig(min_confidence=0.0))
        assert cloud.points.shape == cloud.colors.shape == (0, 3)
        assert cloud.weights.shape == (0,)


def test_a_window_without_depth_adds_nothing() -> None:
    blank = submap_of(np.full((2, *SIZE), np.nan, np.float32))
    good = submap_of(wavy_depth(), index=1)
    alone, both = fuse([good], FusionConfig()), fuse([blank, good], FusionConfig())
    np.testing.assert_array_equal(alone.points, both.points)


def test_submaps_are_streamed() -> None:
    alive: list[weakref.ref[Submap]] = []

    def stream() -> Iterator[Submap]:
        for i in range(6):
            submap = submap_of(wavy_depth(), index=i)
            assert sum(ref() is not None for ref in alive) <= 1  # the one before at most
            alive.append(weakref.ref(submap))
            yield submap
            del submap

    assert len(fuse(stream(), EVERYTHING).points)


def test_memory_grows_with_the_voxels_and_not_with_the_pixels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reserved: list[int] = []
    add = VoxelGrid.add

    def watch(grid: VoxelGrid, *args: object) -> None:
        add(grid, *args)  # type: ignore[arg-type]
        reserved.append(grid.num_reserved)

    monkeypatch.setattr(VoxelGrid, "add", watch)
    depth = np.repeat(wavy_depth(1), 4, axis=1).repeat(4, axis=2).repeat(5, axis=0)
    submap = submap_of(depth)
    fuse([submap] * 20, EVERYTHING.model_copy(update={"voxel_size": 0.002, "tile_bits": 12}))
    assert reserved[0] < reserved[4]  # it does grow at first
    assert len(set(reserved[10:])) == 1
