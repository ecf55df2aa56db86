"""The pose graph finds the places of windows, whatever drifted and whatever closure is wrong."""

import dataclasses
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from laps import SIGMAS, Plan, disturb, error, measure, sigmas_in
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import chi2

from laser_slam import dependencies
from laser_slam.config import PoseGraphConfig
from laser_slam.errors import DatasetError, DegenerateGeometryError, DependencyError
from laser_slam.pose_graph import (
    Link,
    MovedWindow,
    PoseGraph,
    read_g2o,
    spread_corrections,
    spread_poses,
    write_g2o,
)
from laser_slam.pose_graph.tangent import from_gtsam, local_information, parent_sigmas, to_gtsam
from laser_slam.sim3 import Sim3, interpolate_sim3, rotation_exp, rotation_log
from laser_slam.types import Registration

Array = NDArray[np.float64]
CONFIG = PoseGraphConfig()


def random_sim3(rng: np.random.Generator) -> Sim3:
    return Sim3(float(np.exp(rng.normal())), rotation_exp(rng.normal(size=3)), rng.normal(size=3))


# The group in GTSAM


@pytest.mark.parametrize("seed", range(10))
def test_gtsam_and_our_sim3_move_the_same_point_to_the_same_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    c_from_b, b_from_a, point = random_sim3(rng), random_sim3(rng), rng.normal(size=3)
    theirs = to_gtsam(c_from_b) * to_gtsam(b_from_a)
    ours = c_from_b @ b_from_a
    np.testing.assert_allclose(theirs.transformFrom(point), ours.apply(point), rtol=1e-12)
    np.testing.assert_allclose(from_gtsam(theirs).matrix(), ours.matrix(), rtol=1e-12, atol=1e-12)
    back = to_gtsam(c_from_b).inverse()
    np.testing.assert_allclose(from_gtsam(back).matrix(), c_from_b.inverse().matrix(), atol=1e-12)


def local_errors(measured: Sim3, others: list[Sim3]) -> Array:
    """Return what GTSAM's factor sees of similarities beside a measured one."""
    errors = [gtsam.Similarity3.Logmap(to_gtsam(measured.inverse() @ s)) for s in others]
    return np.array(errors)


@pytest.mark.parametrize("seed", range(4))
def test_the_sigmas_of_a_link_become_the_covariance_that_its_errors_have(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, sigmas = random_sim3(rng), 1e-3 * np.exp(rng.normal(size=7))
    errors = local_errors(true, [disturb(true, sigmas, rng) for _ in range(4000)])
    expected = np.linalg.inv(local_information(true, sigmas))
    root = np.linalg.inv(np.linalg.cholesky(expected))
    sampled = root @ np.cov(errors.T) @ root.T
    np.testing.assert_allclose(sampled, np.eye(7), atol=5 / np.sqrt(2000))
    assert np.abs(expected - np.diag(np.diag(expected))).max() > 1e-8  # no diagonal would do


@pytest.mark.parametrize("seed", range(4))
def test_the_covariance_of_a_link_is_the_derivative_of_its_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, sigmas, small = random_sim3(rng), np.exp(rng.normal(size=7)), 1e-6

    class OneByOne:
        def __init__(self, axis: int) -> None:
            self.axis = axis

        def normal(self, size: int) -> Array:
            return np.asarray(np.eye(size)[self.axis])

    moved = [disturb(true, small * sigmas, OneByOne(axis)) for axis in range(7)]  # type: ignore[arg-type]
    slopes = local_errors(true, moved) / small
    np.testing.assert_allclose(
        slopes.T @ slopes, np.linalg.inv(local_information(true, sigmas)), rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(parent_sigmas(true, slopes.T @ slopes), sigmas, rtol=1e-4)


# The fit


def gap(found: Sim3, truth: Sim3) -> Array:
    """Return the 7 errors in the order and units of ``marginal_sigmas``."""
    turn = rotation_log(truth.rotation @ found.rotation.T)
    growth = np.log(truth.scale / found.scale)
    return np.concatenate([turn, truth.translation - found.translation, [growth]])


def test_closures_bring_a_noisy_drive_back_within_its_noise() -> None:
    costs, normalised = [], []
    for seed in range(8):
        drive = measure(Plan(num=100), seed)
        graph = drive.graph()
        result = graph.optimise()
        found = result.world_from_window
        assert result.is_trusted.all()
        assert error(found.values(), drive.truth) < 0.4 * error(drive.chained, drive.truth)
        assert result.cost_after < 1e-2 * result.cost_before
        assert (result.misfits < np.sqrt(chi2.ppf(1 - 1e-5, 7))).all()
        costs.append(2 * result.cost_after)
        for index, sigmas in graph.marginal_sigmas(range(9, 100, 10)).items():
            normalised.append(gap(found[index], drive.truth[index]) / sigmas)
    freedom = 7 * 12 * len(costs)  # every closure adds 7 numbers more than there are unknown
    assert chi2.ppf(1e-4, freedom) < sum(costs) < chi2.ppf(1 - 1e-4, freedom)
    spread = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert (spread > 0.6).all()
    assert (spread < 1.5).all()


@pytest.mark.parametrize("unit", [1e-2, 1e2])
def test_the_unit_of_the_world_changes_nothing(unit: float) -> None:
    drive = measure(Plan(num=100, wrong=3), 0)
    result = drive.graph().optimise()
    world_from_old = Sim3(unit, rotation_exp(np.array([0.1, 0.2, 0.3])), np.ones(3))
    again = drive.graph(start=[world_from_old @ place for place in drive.chained]).optimise()
    assert (again.is_trusted == result.is_trusted).all()
    for index, place in result.world_from_window.items():
        expected = (world_from_old @ place).translation
        np.testing.assert_allclose(
            again.world_from_window[index].translation, expected, atol=1e-2 * unit
        )


@pytest.mark.parametrize("seed", range(3))
def test_a_chain_whose_scale_drifts_by_a_factor_of_twenty_closes(seed: int) -> None:
    drive = measure(Plan(num=300, lap=100, closures=20, growth=0.01), seed)
    assert drive.chained[-1].scale / drive.truth[-1].scale > 15
    result = drive.graph().optimise()
    assert result.is_trusted.all()
    assert error(result.world_from_window.values(), drive.truth) < 0.3 * error(
        drive.chained, drive.truth
    )
    closed = result.world_from_window[299].scale / drive.truth[299].scale
    assert 0.5 < closed < 2.5  # the loops pin the scale where they are


def test_the_start_may_lie_far_from_the_solution() -> None:
    drive, rng = measure(Plan(num=100), 0), np.random.default_rng(0)
    start = drive.chained[:1]
    for place in drive.chained[1:]:
        turn, growth = rotation_exp(0.3 * rng.normal(size=3)), float(np.exp(rng.normal()))
        start.append(place @ Sim3(growth, turn, 9 * rng.normal(size=3)))
    cost = drive.graph().optimise().cost_after
    assert drive.graph(start=start).optimise().cost_after == pytest.approx(cost, rel=1e-3)


# Wrong closures


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("growth", [0.0, 0.004])
def test_wrong_closures_do_not_bend_the_map(share: float, growth: float) -> None:
    for seed in range(2):
        plan = Plan(num=120, lap=40, closures=20, wrong=int(20 * share), growth=growth)
        drive = measure(plan, seed)
        result = drive.graph().optimise()
        assert not (result.is_trusted & ~drive.is_right).any()
        assert (result.is_trusted | ~drive.is_right).mean() > 0.9
        alone = drive.graph(right_only=True).optimise()
        errors = [error(r.world_from_window.values(), drive.truth) for r in (result, alone)]
        assert errors[0] < 1.05 * errors[1]


def test_a_wrong_closure_without_a_right_one_is_left_out() -> None:
    for seed in range(5):
        drive = measure(Plan(closures=1, wrong=1), seed)
        result = drive.graph().optimise()
        assert not result.is_trusted.any()
        assert error(result.world_from_window.values(), drive.chained) < 1e-3
        assert result.misfits[0] > 100


def test_wrong_closures_that_agree_with_each_other_do_not_outvote_the_chain() -> None:
    for seed in range(3):
        drive = measure(Plan(closures=8), seed)
        graph = drive.graph()
        for shift in range(4):  # two streets that look alike, a third of a lap apart
            a, b = 60 + shift, 60 + 17 + shift
            a_from_b = drive.truth[a].inverse() @ drive.truth[a + 1]
            graph.add_closure(a, b, a_from_b, sigmas_in(drive.truth[a]))
        is_trusted = graph.optimise().is_trusted
        assert is_trusted[:8].all()
        assert not is_trusted[8:].any()


def test_closures_may_come_one_by_one() -> None:
    drive = measure(Plan(num=150, closures=10, wrong=4), 1)
    expected, graph = drive.graph().optimise(), PoseGraph(CONFIG)
    waiting = sorted(zip(drive.closures, drive.is_right, strict=True), key=lambda pair: pair[0][1])
    flags: list[bool] = []
    graph.add_window(0, drive.chained[0])
    for index, registration in enumerate(drive.registrations, start=1):
        graph.add_window(index, graph.places[index - 1] @ registration.previous_from_current)
        graph.add_registration(index - 1, index, registration)
        while waiting and waiting[0][0][1] == index:
            closure, is_right = waiting.pop(0)
            flags.append(bool(is_right))
            graph.add_closure(*closure)
            result = graph.optimise()
    assert (result.is_trusted == flags).all()
    assert result.cost_after == pytest.approx(expected.cost_after, rel=1e-3)


@pytest.mark.parametrize("seed", range(2))
def test_a_chain_gives_way_further_the_more_closures_agree(seed: int) -> None:
    for growth, expected in ((0.002, [1, 2, 3]), (0.012, [0, 2, 3]), (0.02, [0, 0, 3])):
        drive = measure(Plan(num=100, closures=0, growth=growth), seed)
        truth, graph, trusted = drive.truth, drive.graph(), []
        for a, b in ((0, 99), (1, 98), (2, 97)):
            graph.add_closure(a, b, truth[a].inverse() @ truth[b], sigmas_in(truth[a]))
            trusted.append(int(graph.optimise().is_trusted.sum()))
        assert trusted == expected


def test_right_closures_are_kept_without_any_doubt_about_the_chain() -> None:
    for seed in range(3):
        drive = measure(Plan(closures=20, wrong=6), seed)
        is_trusted = drive.graph(PoseGraphConfig(max_stretch=1)).optimise().is_trusted
        assert (is_trusted == drive.is_right).all()


# Corrections of frames


def drifting_loop(num: int = 50, frames: int = 10) -> Iterator[MovedWindow]:
    """Drive a loop whose scale and heading drift, and take both back evenly."""
    step = np.eye(4)
    step[:3, 3] = [0.0, 0.0, 1.0]
    step[:3, :3] = rotation_exp(np.array([0.0, 2 * np.pi / (num * frames), 0.0]))
    poses = np.array([np.linalg.matrix_power(step, k) for k in range(frames)])
    next_from = Sim3.from_matrix(np.linalg.matrix_power(step, frames))
    drift = Sim3(1.05, rotation_exp(np.array([0.01, 0.03, 0.0])), np.array([0.3, 0.0, 0.5]))
    before, after = Sim3(), Sim3()
    for _ in range(num):
        yield MovedWindow(poses, before, after)
        before, after = before @ next_from, after @ next_from @ drift


def step_changes(after: Array) -> Array:
    """Return how much each step's length changes against the step before it."""
    lengths = np.linalg.norm(np.diff(after[:, :3, 3], axis=0), axis=1)
    return np.asarray(np.abs(np.diff(np.log(lengths))))


def test_no_frame_jumps_at_the_border_of_windows() -> None:
    windows = list(drifting_loop())
    rigid = np.concatenate([w.after.apply_poses(w.window_from_cam) for w in windows])
    smooth = spread_poses(windows)
    assert smooth.shape == rigid.shape
    assert step_changes(smooth).max() < 0.05
    assert step_changes(rigid).max() > 0.4
    span = np.linalg.norm(np.ptp(rigid[:, :3, 3], axis=0))
    assert np.linalg.norm(smooth[:, :3, 3] - rigid[:, :3, 3], axis=1).max() < 0.02 * span


def test_turns_are_spread_as_evenly_as_moves() -> None:
    windows = list(drifting_loop())

    def largest(poses: Array) -> float:
        relative = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
        return float(np.linalg.norm(np.diff(rotation_log(relative), axis=0), axis=1).max())

    rigid = np.concatenate([w.after.apply_poses(w.window_from_cam) for w in windows])
    assert largest(spread_poses(windows)) < 0.2 * largest(rigid)


def test_the_middle_of_a_window_moves_as_the_window_does() -> None:
    windows = list(drifting_loop(num=6, frames=9))
    for window, places in zip(windows, spread_corrections(windows), strict=True):
        assert len(places) == 9
        np.testing.assert_allclose(places[4].matrix(), window.after.matrix(), atol=1e-9)


def test_frames_stay_where_nothing_moved_and_windows_may_own_none() -> None:
    windows = [dataclasses.replace(w, after=w.before) for w in drifting_loop(num=6)]
    windows[2] = dataclasses.replace(windows[2], window_from_cam=np.zeros((0, 4, 4)))
    expected = np.concatenate([w.before.apply_poses(w.window_from_cam) for w in windows])
    np.testing.assert_allclose(spread_poses(windows), expected, atol=1e-9)
    assert spread_poses([]).shape == (0, 4, 4)
    assert spread_corrections([windows[2]]) == [[]]


@pytest.mark.parametrize("seed", range(5))
def test_the_way_between_two_similarities_has_a_constant_rate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second, moved = random_sim3(rng), random_sim3(rng), random_sim3(rng)
    way = interpolate_sim3(first, second, np.linspace(0, 1, 6))
    for end, found in ((first, way[0]), (second, way[-1])):
        np.testing.assert_allclose(found.matrix(), end.matrix(), atol=1e-12)
    steps = [(a.inverse() @ b).matrix() for a, b in pairwise(way)]
    np.testing.assert_allclose(steps, np.tile(steps[0], (5, 1, 1)), atol=1e-12)
    elsewhere = interpolate_sim3(moved @ first, moved @ second, np.array([0.4]))[0]
    np.testing.assert_allclose((moved @ way[2]).matrix(), elsewhere.matrix(), atol=1e-12)


# g2o files


def assert_same_links(first: list[Link], second: list[Link]) -> None:
    for one, other in zip(first, second, strict=True):
        assert (one.a, one.b) == (other.a, other.b)
        np.testing.assert_allclose(other.a_from_b.matrix(), one.a_from_b.matrix(), atol=1e-12)
        np.testing.assert_allclose(
            other.information, one.information, rtol=1e-9, atol=1e-9 * one.information.max()
        )


def test_a_graph_written_and_read_is_the_same(tmp_path: Path) -> None:
    graph = measure(Plan(num=60, lap=30, closures=5, wrong=2), 0).graph()
    assert graph.optimise().is_trusted.sum() == 3
    write_g2o(tmp_path / "graph.g2o", graph)
    again = read_g2o(tmp_path / "graph.g2o", CONFIG)
    assert again.places.keys() == graph.places.keys()
    for index, place in graph.places.items():
        np.testing.assert_allclose(again.places[index].matrix(), place.matrix(), atol=1e-12)
    for first, second in zip(graph.links, again.links, strict=True):
        assert_same_links(first, second)
    assert again.optimise().cost_after == pytest.approx(graph.optimise().cost_after, rel=1e-6)


def test_the_numbers_of_a_vertex_are_the_logarithm_of_its_similarity(tmp_path: Path) -> None:
    graph, place = PoseGraph(CONFIG), random_sim3(np.random.default_rng(0))
    graph.add_window(7, place)
    write_g2o(tmp_path / "one.g2o", graph)
    tag, index, *words = (tmp_path / "one.g2o").read_text().split()
    assert (tag, index, len(words)) == ("VERTEX_SIM3:EXPMAP", "7", 15)
    x, y, z, *move, growth = (float(word) for word in words[:7])
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.array([[growth, -z, y], [z, growth, -x], [-y, x, growth]])
    generator[:3, 3] = move
    np.testing.assert_allclose(expm(generator), place.matrix(), atol=1e-12)


def rigid_graph() -> PoseGraph:
    rng = np.random.default_rng(2)
    graph, place = PoseGraph(CONFIG), Sim3()
    graph.add_window(0, place)
    for index in range(1, 5):
        step = Sim3(1.0, rotation_exp(0.3 * rng.normal(size=3)), rng.normal(size=3))
        graph.add_window(index, place := place @ step)
        graph.add_registration(index - 1, index, Registration(step, SIGMAS, 100, 0.0))
    return graph


def test_a_graph_without_scales_reads_as_rigid_elsewhere(tmp_path: Path) -> None:
    graph, path = rigid_graph(), tmp_path / "rigid.g2o"
    write_g2o(path, graph, rigid=True)
    factors, values = gtsam.readG2o(str(path), True)
    assert factors.size() == 4
    for index, place in graph.places.items():
        np.testing.assert_allclose(values.atPose3(index).matrix(), place.matrix(), atol=1e-9)
    again = read_g2o(path, CONFIG)
    for link, other in zip(graph.links[0], again.links[0], strict=True):
        np.testing.assert_allclose(other.a_from_b.matrix(), link.a_from_b.matrix(), atol=1e-12)
        np.testing.assert_allclose(other.information[:6, :6], link.information[:6, :6], rtol=1e-6)
    with pytest.raises(DegenerateGeometryError, match="without scales cannot hold the scale"):
        write_g2o(path, measure(Plan(num=5, closures=0), 0).graph(), rigid=True)


def test_errors_of_a_rigid_edge_are_counted_in_half_angles(tmp_path: Path) -> None:
    path = tmp_path / "rigid.g2o"
    write_g2o(path, rigid_graph(), rigid=True)
    edge = next(line for line in path.read_text().splitlines() if line.startswith("EDGE"))
    upper = [float(word) for word in edge.split()[10:]]
    assert upper[-1] == pytest.approx(4 / SIGMAS[0] ** 2, rel=1e-6)
    assert upper[0] == pytest.approx(1 / SIGMAS[3] ** 2, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE2 0 1 2 3", "line 1: VERTEX_SE2 is no vertex or edge"),
        ("# first\nVERTEX_SIM3:EXPMAP 0 1 2 3", "line 2: got 3 numbers, need 7"),
        ("VERTEX_SIM3:EXPMAP 0 0 0 0 0 0 0 nan", "line 1: a number is not finite"),
        ("VERTEX_SE3:QUAT 0 0 0 x 0 0 0 1", "line 1: could not convert"),
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1" + " 1" * 21, "line 1: window 0 is not in"),
    ],
)
def test_a_broken_file_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.g2o").write_text(text)
    with pytest.raises(DatasetError, match=message):
        read_g2o(tmp_path / "bad.g2o", CONFIG)
    with pytest.raises(DatasetError, match="cannot read the pose graph"):
        read_g2o(tmp_path / "none.g2o", CONFIG)


# Bad input


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("axis", [0, 3, 6])
def test_sigmas_that_are_none_are_refused(bad: float, axis: int) -> None:
    graph = measure(Plan(num=5, closures=0), 0).graph()
    sigmas = np.array(SIGMAS)
    sigmas[axis] = bad
    with pytest.raises(DegenerateGeometryError, match="7 positive finite sigmas, got"):
        graph.add_closure(0, 4, Sim3(), sigmas)
    with pytest.raises(DegenerateGeometryError, match="7 positive finite sigmas, got"):
        graph.add_registration(0, 1, Registration(Sim3(), sigmas, 100, 0.0))


@pytest.mark.parametrize(
    ("a", "b", "information", "message"),
    [
        (0, 9, np.eye(7), "window 9 is not in the pose graph"),
        (1, 1, np.eye(7), "window 1 cannot be linked to itself"),
        (0, 1, -np.eye(7), "from window 0 to 1 is not a finite, symmetric, positive"),
        (0, 1, np.eye(6), "positive definite 7x7"),
        (0, 1, np.triu(np.ones((7, 7))), "symmetric"),
        (0, 1, np.full((7, 7), np.nan), "finite"),
    ],
)
def test_links_that_make_no_sense_are_refused(
    a: int, b: int, information: Array, message: str
) -> None:
    graph = measure(Plan(num=5, closures=0), 0).graph()
    with pytest.raises(DegenerateGeometryError, match=message):
        graph.add_link(Link(a, b, Sim3(), information))


def test_windows_must_be_new_and_linked() -> None:
    graph = PoseGraph(CONFIG)
    with pytest.raises(DegenerateGeometryError, match="needs a window"):
        graph.optimise()
    graph.add_window(3, Sim3())
    assert graph.optimise().world_from_window[3].scale == pytest.approx(1.0)
    graph.add_window(4, Sim3())
    with pytest.raises(DegenerateGeometryError, match="window 4 is in the pose graph already"):
        graph.add_window(4, Sim3())
    graph.add_closure(3, 4, Sim3(), SIGMAS)
    for call in (graph.optimise, lambda: graph.marginal_sigmas([4])):
        with pytest.raises(DegenerateGeometryError, match="registrations leads to window 4"):
            call()


def test_a_missing_gtsam_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gtsam", None)
    dependencies.import_gtsam.cache_clear()
    with pytest.raises(DependencyError, match=r"pip install 'gtsam>=4.3'"):
        PoseGraph(CONFIG)
    monkeypatch.undo()
    dependencies.import_gtsam.cache_clear()
