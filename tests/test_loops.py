"""Loops are looked for window by window, in little memory, and every candidate is accounted for."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from loop_rig import DRIFT, Rig, truth
from numpy.typing import NDArray
from ring import (
    LAP,
    MEDIAN_M,
    NO_DRIFT,
    NUM_FRAMES,
    NUM_WINDOWS,
    SIZE,
    TIMES_S,
    Drift,
    ate_m,
    chain,
    frames_of,
    prediction_of,
    ring_pose,
    ring_prediction,
    true_link,
    unit_of,
)

import laser_slam.pose_graph.graph
import laser_slam.slam.loops
from laser_slam.closures import CandidateEnds, Judged, Measurement, Tools
from laser_slam.config import Config, load_config
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Sim3
from laser_slam.slam import read_window
from laser_slam.types import Prediction, WindowStatus


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Make a rig whose candidates are all measured right."""
    return Rig(tmp_path, monkeypatch)


# When and what


def test_a_window_is_looked_at_when_it_is_known_which_frames_it_owns(rig: Rig) -> None:
    for window in range(6):
        rig.add(prediction_of(window, DRIFT))
        owned = [n.frames[n.is_owned].tolist() for n in rig.slam.nodes[:-1]]
        assert rig.marks.seen == [frame for frames in owned for frame in frames]


def test_every_keyframe_is_described_once_the_last_window_at_the_end(rig: Rig) -> None:
    rig.drive()
    rig.closer.finish()
    rig.closer.finish()
    assert rig.marks.seen == list(range(NUM_FRAMES))
    assert [place.frame for place in rig.given] == list(range(NUM_FRAMES))
    assert [place.window for place in rig.given] == [
        node.index for node in rig.slam.nodes for _ in range(int(node.is_owned.sum()))
    ]


def test_a_drive_without_windows_finishes(rig: Rig) -> None:
    rig.closer.finish()
    assert rig.closer.records == []


def test_candidates_join_the_frames_of_one_place_and_close_the_loop(rig: Rig) -> None:
    rig.drive()
    rig.closer.finish()
    records = rig.closer.records
    assert len(records) >= 8
    assert {r.frame_b - r.frame_a for r in records} == {LAP}
    assert [(r.frame_a, r.frame_b) for r in records] == rig.shown
    for record in records:
        for window, frame in (
            (record.window_a, record.frame_a), (record.window_b, record.frame_b)
        ):  # fmt: skip
            node = rig.slam.nodes[window]
            assert node.frames[node.is_owned].tolist().count(frame) == 1
    assert set(rig.verdicts) == {"accepted"}
    without = ate_m(chain(DRIFT).trajectory(TIMES_S))
    assert ate_m(rig.slam.trajectory(TIMES_S)) < 0.5 * without


def test_the_scale_of_the_chain_is_that_of_the_older_over_the_newer_unit(rig: Rig) -> None:
    rig.drive(see=lambda window: prediction_of(window, Drift(0, 0, DRIFT.seed)))
    rig.closer.finish()
    units = [unit_of(window, DRIFT.seed) for window in range(NUM_WINDOWS)]
    expected = [units[r.window_b] / units[r.window_a] for r in rig.closer.records]
    assert len(expected) > 5
    assert np.allclose(rig.chain_scales, expected, rtol=0.02)


def test_both_ends_are_measured_with_their_layers_aligned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each window has the floor, the lower half of its images, at a scale of its own."""
    pairs: list[list[tuple[int, NDArray[np.float32]]]] = []

    def note(ends: CandidateEnds) -> str:
        pairs.append([(end.window, end.prediction.depth) for end in (ends.a, ends.b)])
        return "not today"

    def see(window: int) -> Prediction:
        prediction = prediction_of(window, DRIFT)
        prediction.depth[:, SIZE[0] // 2 :] *= np.float32(1 + 0.1 * (window % 3))
        return prediction

    config = load_config(assignments=["layers.enabled=always"])
    rig = Rig(tmp_path, monkeypatch, note, config)
    rig.drive(see=see)
    rig.closer.finish()
    assert len(pairs) > 5
    for end in (0, 1):
        moved = []
        for window, depth in (pair[end] for pair in pairs):
            stored = read_window(rig.files, window, config)
            assert np.allclose(depth, stored.corrected.depth, rtol=2e-3)
            moved.append(not np.allclose(depth, stored.raw.depth, rtol=0.02))
        assert np.mean(moved) > 0.4


def test_loops_are_closed_on_the_way_and_not_only_at_the_end(rig: Rig) -> None:
    rig.drive(20)
    assert rig.verdicts
    node = rig.slam.nodes[-2]
    assert not np.allclose(node.world_from_window.matrix(), node.chained.matrix(), atol=1e-2)


# The way travelled


def travelled(rig: Rig, units: Callable[[int], float], status: WindowStatus) -> NDArray[np.float64]:
    for window in range(8):
        seen = status if window in (3, 4) else WindowStatus.OK
        rig.add(ring_prediction(frames_of(window), units(window), NO_DRIFT, seen))
    rig.closer.finish()
    nodes = rig.slam.nodes
    assert {place.window for place in rig.given} == {
        node.index for node in nodes if status is WindowStatus.OK or node.index not in (3, 4)
    }
    return np.array([place.travelled for place in rig.given])


def test_the_way_is_counted_in_median_depths(rig: Rig) -> None:
    way = travelled(rig, unit_of, WindowStatus.OK)
    metres = np.linalg.norm(ring_pose(1)[:3, 3]) * np.arange(len(way))
    assert np.allclose(way, metres / MEDIAN_M, rtol=0.15)


@pytest.mark.parametrize("status", list(WindowStatus))
def test_the_way_does_not_depend_on_units_whatever_windows_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: WindowStatus
) -> None:
    ways = []
    for factor in (1.0, 0.01, 100.0):
        rig = Rig(tmp_path / str(factor), monkeypatch)
        ways.append(travelled(rig, lambda window, f=factor: f * unit_of(window), status))  # type: ignore[misc]
    assert np.all(np.diff(ways[0]) >= 0)
    assert np.allclose(ways[1], ways[0], rtol=1e-4)
    assert np.allclose(ways[2], ways[0], rtol=1e-4)


def test_the_way_goes_on_through_a_window_that_failed(rig: Rig) -> None:
    """The motion before is continued there, so the way is about as long as without the failure."""
    way = travelled(rig, lambda _: 0.01, WindowStatus.FAILED)
    total = np.linalg.norm(ring_pose(1)[:3, 3]) * (8 * 5 + 2) / MEDIAN_M
    assert way[-1] == pytest.approx(total, rel=0.15)


# Windows that lack something


@pytest.mark.parametrize("status", [s for s in WindowStatus if s is not WindowStatus.OK])
def test_a_window_that_saw_nothing_is_skipped_and_loops_close_around_it(
    rig: Rig, status: WindowStatus
) -> None:
    blind = {2, 19, 20}
    rig.drive(see=lambda w: prediction_of(w, DRIFT, status if w in blind else WindowStatus.OK))
    rig.closer.finish()
    records = rig.closer.records
    assert len(records) > 3
    assert blind.isdisjoint({r.window_a for r in records} | {r.window_b for r in records})
    unseen = {f for w in blind for f in rig.slam.nodes[w].frames[rig.slam.nodes[w].is_owned]}
    assert unseen.isdisjoint(rig.marks.seen)


def test_a_window_whose_depth_is_unknown_all_over_is_no_exception(rig: Rig) -> None:
    def see(window: int) -> Prediction:
        prediction = prediction_of(window, DRIFT)
        if window == 19:
            prediction.depth[:], prediction.confidence[:] = np.nan, 0
        return prediction

    rig.drive(see=see)
    rig.closer.finish()
    assert np.isfinite([place.travelled for place in rig.given]).all()
    assert len(rig.given) == NUM_FRAMES


# The last word


def test_records_say_what_the_pose_graph_trusts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every third candidate does not match, and the fifth is measured a lap's width off."""
    num = [0]

    def verdict(ends: CandidateEnds) -> Sim3 | str:
        num[0] += 1
        if num[0] % 3 == 0:
            return "the images do not match"
        off = Sim3(translation=np.array([9.0, 0, 0])) if num[0] == 5 else Sim3()
        link = truth(ends)
        assert isinstance(link, Sim3)
        return off @ link

    rig = Rig(tmp_path, monkeypatch, verdict)
    rig.drive()
    rig.closer.finish()
    expected = ["no" if (i + 1) % 3 == 0 else "yes" for i in range(num[0])]
    expected[4] = "off"
    words = {"accepted": "yes", "the images do not match": "no"}
    assert [words.get(verdict, "off") for verdict in rig.verdicts] == expected
    assert "the pose graph distrusts it, " in rig.verdicts[4]


def test_a_closure_that_breaks_the_solver_is_left_out_and_the_next_ones_hold(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve, calls = laser_slam.pose_graph.graph.solve, [0]

    def fragile(*problem: object) -> object:
        calls[0] += 1
        if calls[0] in (1, 3):
            raise DegenerateGeometryError("the pose graph cannot be solved: singular")
        return solve(*problem)  # type: ignore[arg-type]

    monkeypatch.setattr(laser_slam.pose_graph.graph, "solve", fragile)
    rig.drive()
    rig.closer.finish()
    broken = ["cannot be solved" in verdict for verdict in rig.verdicts]
    assert broken == [i in (0, 2) for i in range(len(broken))]
    assert rig.slam.optimised is not None
    assert len(rig.slam.optimised.is_trusted) == len(broken) - 2
    assert ate_m(rig.slam.trajectory(TIMES_S)) < 0.5


def test_a_measurement_without_sigmas_is_a_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(tmp_path, monkeypatch)
    known = true_link(0, 18, DRIFT.seed)[1]
    sigmas = iter([known * np.nan, known * 0])

    def judge(ends: CandidateEnds, tools: Tools, config: Config) -> Judged:
        judged = rig.judge(ends, tools, config)
        assert judged.measurement is not None
        bad = Measurement(
            judged.measurement.a_from_b, np.diag(next(sigmas, known) ** 2), 9, 9, 0.01, "nothing"
        )
        return Judged(judged.record, bad)

    monkeypatch.setattr(laser_slam.slam.loops, "judge", judge)
    rig.drive()
    rig.closer.finish()
    assert ["sigma" in verdict for verdict in rig.verdicts[:3]] == [True, True, False]


# Bounds


def test_old_windows_are_read_for_candidates_only_and_few_for_each_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for most in (1, 6):
        config = load_config(assignments=[f"places.max_per_window={most}", "places.suppression=0"])
        rig = Rig(tmp_path / str(most), monkeypatch, config=config)
        for window in range(NUM_WINDOWS):
            before = len(rig.files.read)
            rig.add(prediction_of(window, DRIFT))
            assert len(rig.files.read) - before <= most
        rig.closer.finish()
        assert rig.files.read == [record.window_a for record in rig.closer.records]
        assert len(rig.files.read) >= 3


def test_no_more_than_the_windows_at_work_are_in_memory(rig: Rig) -> None:
    """One that waits, the one that was added last, and the old one of the candidate."""
    rig.drive()
    assert sum(ref() is not None for ref in rig.files.alive) == 1
    rig.closer.finish()
    assert max(rig.num_alive) == 3
    assert rig.closer._waiting is None
