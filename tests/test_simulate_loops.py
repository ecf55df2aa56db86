"""Simulated drives close the loops that are there, and no others."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from loop_drives import ChainedDrive, Stopwatch, chain_drive, close_loops, measure_revisits
from revisits import FAR_M, LoopClosure, RevisitRule, find_revisits, invent_closures
from simulate_loops import PUBLISHED, SEQUENCES, SETTINGS, main, with_decision, with_seed
from typer import Typer
from typer.testing import CliRunner

from laser_slam.config import load_config
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.paths import loop_path
from laser_slam.evaluation.trajectory import path_distances
from laser_slam.types import Trajectory

NUM_FRAMES = 330
RULE = RevisitRule(gap_m=80, apart_m=10)


def trajectory(path: np.ndarray) -> Trajectory:
    frames = np.arange(len(path))
    return Trajectory(frames, frames / 10, path)


def circle(num_frames: int, laps: float, radius_m: float, direction: int = 1) -> np.ndarray:
    """Drive round a circle at a constant height, looking ahead."""
    angle = direction * np.linspace(0, 2 * np.pi * laps, num_frames)
    path = np.tile(np.eye(4), (num_frames, 1, 1))
    ahead = np.stack([np.sin(-angle), 0 * angle, np.cos(angle)], axis=1) * direction
    path[:, :3, 0] = np.cross([0.0, 1.0, 0.0], ahead)
    path[:, :3, 2] = ahead
    path[:, :3, 3] = radius_m * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    return path


@pytest.fixture(scope="module")
def chained() -> ChainedDrive:
    config = with_seed(load_config(assignments=SETTINGS), 1)
    drive = SyntheticDrive(config.synthetic, loop_path(NUM_FRAMES, 0.9, 0))
    return chain_drive(drive, config, Stopwatch(), lambda _: None)


@pytest.fixture(scope="module")
def right(chained: ChainedDrive) -> list[LoopClosure]:
    return measure_revisits(chained, RULE, Stopwatch())[0]


def test_a_second_lap_revisits_the_first_a_few_times() -> None:
    """One lap is 251 m; half of it is driven a second time: 126 m, a pair every 20 to 40 m."""
    truth = trajectory(circle(400, 1.5, 40))
    revisits = find_revisits(truth, RevisitRule(apart_m=20))
    assert 3 <= len(revisits) <= 7
    assert np.allclose(np.diff(revisits, axis=1), 399 / 1.5, atol=5)
    travelled = path_distances(truth)[revisits[:, 1]]
    # places on one side are that far apart; on the other, a pair may be 4 m askew
    assert all(after - before >= 20 - 2 * 4 for before, after in pairwise(travelled))


def test_one_lap_revisits_nothing() -> None:
    assert len(find_revisits(trajectory(circle(400, 0.95, 40)), RevisitRule())) == 0


def test_the_way_back_is_no_revisit() -> None:
    there = circle(200, 0.8, 40)
    back = there[::-1].copy()
    back[:, :3, [0, 2]] *= -1
    assert len(find_revisits(trajectory(np.concatenate([there, back])), RevisitRule())) == 0


def test_closures_take_most_of_the_drift_away(
    chained: ChainedDrive, right: list[LoopClosure]
) -> None:
    outcome = close_loops(chained, right, chained.config)
    assert outcome.given == (len(right), 0)
    assert outcome.kept == outcome.given
    assert len(right) >= 2
    assert outcome.ate_m < 0.6 * chained.ate_m(chained.slam)


def test_wrong_closures_are_left_out_and_would_bend_a_plain_fit(
    chained: ChainedDrive, right: list[LoopClosure]
) -> None:
    wrong = invent_closures(3, chained.slam.nodes, chained.truth, right)
    doubted = close_loops(chained, [*right, *wrong], chained.config)
    plain = close_loops(chained, [*right, *wrong], with_decision(chained.config, False))
    assert doubted.kept == (len(right), 0)
    assert plain.kept == plain.given == (len(right), 3)
    assert doubted.ate_m == pytest.approx(close_loops(chained, right, chained.config).ate_m, 0.05)
    assert plain.ate_m > 3 * doubted.ate_m


def test_wrong_closures_are_left_out_where_the_solver_has_no_covariance(
    chained: ChainedDrive, right: list[LoopClosure], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chains in knots happen on drives of kilometres; GTSAM then raises this."""

    def fail(*_arguments: object) -> None:
        raise RuntimeError("Indeterminate linear system detected")

    monkeypatch.setattr("gtsam.Marginals", fail)
    wrong = invent_closures(3, chained.slam.nodes, chained.truth, right)
    outcome = close_loops(chained, [*right, *wrong], chained.config)
    assert outcome.kept[1] == 0
    assert outcome.ate_m < chained.ate_m(chained.slam)


def test_closing_loops_leaves_the_chain_as_it_was(
    chained: ChainedDrive, right: list[LoopClosure]
) -> None:
    before = chained.ate_m(chained.slam)
    close_loops(chained, right, chained.config)
    assert chained.ate_m(chained.slam) == before


def test_measured_revisits_put_the_cameras_where_they_are(chained: ChainedDrive) -> None:
    """The loop window turns by a few tenths of a degree over its 20 frames, and slips 2 %."""
    _, off = measure_revisits(chained, RULE, Stopwatch())
    assert np.all(off < [3.0, 1.5])
    assert np.all(off > 0)


def test_invented_closures_are_far_apart_and_groups_agree(
    chained: ChainedDrive, right: list[LoopClosure]
) -> None:
    nodes, truth = chained.slam.nodes, chained.truth
    wrong = invent_closures(6, nodes, truth, right, group=2)
    assert len(wrong) == 6
    assert not any(closure.is_right for closure in wrong)
    firsts = [closure for i, closure in enumerate(wrong) if i == 0 or _after(wrong[i - 1], closure)]
    for closure in firsts:
        middle = [nodes[w].frames[len(nodes[w].frames) // 2] for w in (closure.a, closure.b)]
        a, b = truth.world_from_cam[middle, :3, 3]
        assert np.linalg.norm(a - b) > FAR_M
    followed = [(one, two) for one, two in pairwise(wrong) if two.a == one.a + 1]
    assert followed
    for one, two in followed:
        a_step, b_step = nodes[two.a].registration, nodes[two.b].registration
        assert a_step is not None
        assert b_step is not None
        way = a_step.previous_from_current @ two.a_from_b
        other = one.a_from_b @ b_step.previous_from_current
        np.testing.assert_allclose(way.matrix(), other.matrix(), atol=1e-9)


def _after(one: LoopClosure, two: LoopClosure) -> bool:
    return (two.a, two.b) != (one.a + 1, one.b + 1)


def test_the_tool_writes_both_tables(tmp_path: Path) -> None:
    poses = loop_path(100, 0.9, 0)[:, :3].reshape(-1, 12)
    np.savetxt(tmp_path / "07.txt", poses)
    app = Typer()
    app.command()(main)
    told = CliRunner().invoke(app, [str(tmp_path), "--seeds", "1", "--wrong", "0", "--markdown"])
    assert told.exit_code == 0, told.output
    rows = [line.split(" | ") for line in told.stdout.splitlines() if line.startswith("| 07")]
    assert len(rows) == 2
    laser = PUBLISHED["LASER pi3"][SEQUENCES.index("07")]
    assert rows[0][-1] == f"{laser:.2f} |"
    assert float(rows[0][4]) == float(rows[0][5])  # no revisit: what is chained stays
    assert "0/0 right, 0/0 wrong" in rows[1]


def test_a_missing_trajectory_is_named(tmp_path: Path) -> None:
    app = Typer()
    app.command()(main)
    told = CliRunner().invoke(app, [str(tmp_path), "--only", "00"])
    assert told.exit_code == 1
    assert "00.txt" in told.output
