"""Sim(3) is a group, acts on points and poses alike, and is recovered from points."""

import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import (
    Sim3,
    interpolate_poses,
    orthonormal,
    rotation_exp,
    rotation_log,
    umeyama,
)

Array = NDArray[np.float64]
SEEDS = range(10)


def random_sim3(rng: np.random.Generator) -> Sim3:
    return Sim3(np.exp(rng.normal()), rotation_exp(rng.normal(size=3)), rng.normal(size=3))


def assert_same(first: Sim3, second: Sim3, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(first.matrix(), second.matrix(), atol=atol)


@pytest.mark.parametrize("seed", SEEDS)
def test_similarities_form_a_group(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (random_sim3(rng) for _ in range(3))
    assert_same((a @ b) @ c, a @ (b @ c), 1e-10)
    assert_same(a @ a.inverse(), Sim3(), 1e-10)
    assert_same(a.inverse() @ a, Sim3(), 1e-10)
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse(), 1e-10)
    assert_same(a @ Sim3(), a)
    assert_same(a.inverse().inverse(), a)


@pytest.mark.parametrize("seed", SEEDS)
def test_composition_composes_the_maps_of_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_sim3(rng), random_sim3(rng)
    points = rng.normal(size=(4, 5, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-10)
    homogeneous = np.append(points[0, 0], 1) @ a.matrix().T
    np.testing.assert_allclose(homogeneous[:3], a.apply(points[0, 0]), atol=1e-12)


def test_scale_acts_before_the_translation() -> None:
    turned = Sim3(2.0, rotation_exp(np.array([0, 0, np.pi / 2])), np.array([10.0, 0.0, 0.0]))
    np.testing.assert_allclose(turned.apply(np.array([1.0, 0.0, 0.0])), [10, 2, 0], atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_move_with_their_points(seed: int) -> None:
    """A point that a camera sees stays where the camera sees it, but for the unit."""
    rng = np.random.default_rng(seed)
    b_from_a = random_sim3(rng)
    a_from_cam = np.array(Sim3(1.0, rotation_exp(rng.normal(size=3)), rng.normal(size=3)).matrix())
    in_cam = rng.normal(size=3)
    in_b = b_from_a.apply(Sim3.from_matrix(a_from_cam).apply(in_cam))
    b_from_cam = b_from_a.apply_poses(a_from_cam[None])[0]
    np.testing.assert_allclose(
        np.linalg.inv(b_from_cam) @ np.append(in_b, 1),
        np.append(b_from_a.scale * in_cam, 1),
        atol=1e-10,
    )
    np.testing.assert_allclose(b_from_cam[:3, :3] @ b_from_cam[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_matrix_there_and_back_is_the_same(seed: int) -> None:
    sim3 = random_sim3(np.random.default_rng(seed))
    assert_same(Sim3.from_matrix(sim3.matrix()), sim3)


def test_a_chain_of_thousands_stays_a_similarity() -> None:
    rng = np.random.default_rng(0)
    chain, step = Sim3(), Sim3(1.0, rotation_exp(0.1 * rng.normal(size=3)), rng.normal(size=3))
    for _ in range(5000):
        chain = chain @ step
    np.testing.assert_allclose(chain.rotation @ chain.rotation.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(chain.rotation) == pytest.approx(1)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scale_that_is_none_is_refused(scale: float) -> None:
    with pytest.raises(DegenerateGeometryError, match="positive scale"):
        Sim3(scale)


def test_what_is_no_rotation_is_refused() -> None:
    with pytest.raises(DegenerateGeometryError, match="rotation"):
        Sim3(1.0, 2 * np.eye(3))
    with pytest.raises(DegenerateGeometryError, match="rotation"):
        Sim3(1.0, np.diag([1.0, 1.0, -1.0]))  # a reflection
    with pytest.raises(DegenerateGeometryError, match="finite"):
        Sim3(1.0, np.full((3, 3), np.nan))
    with pytest.raises(DegenerateGeometryError, match="finite"):
        Sim3(1.0, np.eye(3), np.array([0.0, np.inf, 0.0]))


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([0.0, 0.0, 0.0, 1.0])])
def test_a_matrix_that_is_no_similarity_is_refused(matrix: Array) -> None:
    with pytest.raises(DegenerateGeometryError):
        Sim3.from_matrix(matrix)


def test_a_similarity_keeps_its_numbers_when_its_source_changes() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    sim3 = Sim3(1.0, rotation, translation)
    rotation[:], translation[:] = 7, 7
    assert_same(sim3, Sim3())


@pytest.mark.parametrize("seed", SEEDS)
def test_the_nearest_rotation_is_a_rotation_and_nearest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = rotation_exp(rng.normal(size=3))
    noisy = rotation + 0.05 * rng.normal(size=(3, 3))
    best = orthonormal(noisy)
    np.testing.assert_allclose(best @ best.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(best) == pytest.approx(1)
    np.testing.assert_allclose(orthonormal(rotation), rotation, atol=1e-12)
    for _ in range(20):
        other = rotation_exp(1e-3 * rng.normal(size=3)) @ best
        assert np.linalg.norm(noisy - best) <= np.linalg.norm(noisy - other)
    assert np.linalg.det(orthonormal(-noisy)) == pytest.approx(1)


def test_rotation_vectors_come_back() -> None:
    vectors = np.random.default_rng(0).uniform(-1.7, 1.7, (4, 5, 3))  # shorter than pi
    np.testing.assert_allclose(rotation_log(rotation_exp(vectors)), vectors, atol=1e-12)
    assert rotation_log(np.eye(3)).shape == (3,)
    assert rotation_log(np.empty((0, 3, 3))).shape == (0, 3)
    assert rotation_exp(np.empty((0, 3))).shape == (0, 3, 3)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("with_scale", [True, False])
def test_umeyama_finds_a_known_similarity(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    truth = random_sim3(rng)
    truth = truth if with_scale else Sim3(1.0, truth.rotation, truth.translation)
    points = rng.normal(size=(20, 3))
    for unit in (1.0, 0.01, 100.0):
        found = umeyama(unit * points, truth.apply(unit * points), with_scale=with_scale)
        assert_same(found, truth, 1e-9 * unit + 1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_umeyama_is_the_least_squares_optimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(15, 3))
    target = random_sim3(rng).apply(source) + 0.1 * rng.normal(size=(15, 3))
    weights = rng.uniform(0, 1, 15)

    def cost(sim3: Sim3) -> float:
        return float(weights @ ((sim3.apply(source) - target) ** 2).sum(axis=1))

    best = umeyama(source, target, weights=weights)
    for _ in range(30):
        nudge = Sim3(
            np.exp(1e-3 * rng.normal()),
            rotation_exp(1e-3 * rng.normal(size=3)),
            1e-3 * rng.normal(size=3),
        )
        assert cost(best) <= cost(nudge @ best)


def test_weights_count_as_repeated_points() -> None:
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(2, 6, 3))
    counts = np.array([1, 2, 3, 1, 1, 4])
    assert_same(
        umeyama(source, target, weights=counts.astype(float)),
        umeyama(np.repeat(source, counts, axis=0), np.repeat(target, counts, axis=0)),
        1e-10,
    )


def test_flat_point_sets_give_a_rotation_and_no_mirror() -> None:
    rng = np.random.default_rng(1)
    truth = random_sim3(rng)
    flat = rng.normal(size=(10, 3)) * [1, 1, 0]
    assert_same(umeyama(flat, truth.apply(flat)), truth, 1e-9)


@pytest.mark.parametrize("place", [np.zeros(3), np.array([1.1, 2.2, 3.3]), 1e6 * np.ones(3) / 3])
def test_points_in_one_place_are_refused(place: Array) -> None:
    points = np.tile(place, (7, 1))
    with pytest.raises(DegenerateGeometryError, match="more than one place"):
        umeyama(points, np.random.default_rng(0).normal(size=(7, 3)))


def test_two_points_are_refused() -> None:
    with pytest.raises(DegenerateGeometryError, match="needs 3 points, got 2"):
        umeyama(np.eye(3)[:2], np.eye(3)[:2])


def test_targets_in_one_place_have_no_scale() -> None:
    with pytest.raises(DegenerateGeometryError, match="target points in more"):
        umeyama(np.random.default_rng(0).normal(size=(7, 3)), np.ones((7, 3)))


def known_poses(num: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, :3, :3] = rotation_exp(rng.normal(size=(num, 3)))
    poses[:, :3, 3] = rng.normal(size=(num, 3))
    return np.cumsum(rng.uniform(0.1, 2, num)), poses


def test_interpolation_passes_through_the_known_poses() -> None:
    times, poses = known_poses(6)
    np.testing.assert_allclose(interpolate_poses(times, times, poses), poses, atol=1e-12)


def test_halfway_is_half_the_way_and_half_the_turn() -> None:
    times, poses = known_poses(2)
    middle = interpolate_poses(np.array([times.mean()]), times, poses)[0]
    np.testing.assert_allclose(middle[:3, 3], poses[:, :3, 3].mean(axis=0), atol=1e-12)
    first, second = (
        rotation_log(middle[:3, :3] @ poses[0, :3, :3].T),
        rotation_log(poses[1, :3, :3] @ middle[:3, :3].T),
    )
    np.testing.assert_allclose(first, second, atol=1e-10)
    np.testing.assert_allclose(middle[:3, :3] @ middle[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("num", [1, 3])
def test_beyond_the_ends_the_pose_is_held(num: int) -> None:
    times, poses = known_poses(num)
    held = interpolate_poses(np.array([times[0] - 5, times[-1] + 5]), times, poses)
    np.testing.assert_allclose(held, poses[[0, -1]], atol=1e-12)
    assert interpolate_poses(np.empty(0), times, poses).shape == (0, 4, 4)
