"""What a run shows and says of its loops: right numbers, whole files, readable pictures."""

import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from ring import (
    NO_DRIFT,
    NUM_FRAMES,
    TIMES_S,
    Drift,
    ate_m,
    black,
    chain,
    prediction_of,
    ring_pose,
    ring_prediction,
    true_link,
    unit_of,
)

import laser_slam.places.similarity
from laser_slam.closures import ClosureRecord, read_closures
from laser_slam.config import Config
from laser_slam.console import summarize
from laser_slam.errors import DegenerateGeometryError
from laser_slam.places import PlaceIndex
from laser_slam.places.similarity import SimilarityMap, map_similarities
from laser_slam.pose_graph import PoseGraph, read_g2o
from laser_slam.report import (
    ImagePair,
    LoopPaths,
    ScaleCurves,
    frame_pairs,
    loops_picture,
    pairs_picture,
    scales_picture,
    similarity_picture,
)
from laser_slam.report.loops import ACCEPTED, REJECTED
from laser_slam.results import describe_loops, look_back, write_report
from laser_slam.results.loop_pictures import choose_pairs, draw_loops, scale_curves
from laser_slam.results.loops import Loops, write_loops
from laser_slam.slam import Slam
from laser_slam.store import WindowFiles
from laser_slam.types import Trajectory

DRIFT = Drift(seed=1)
CLOSED = [(0, 18), (1, 19), (3, 21)]
GOOD = ClosureRecord(0, 18, 3, 93, 0.5, "accepted", 200, 3, 400, 0.02, 1.1, 1.0, 2.0)
BAD = replace(GOOD, verdict="depths differ by 0.31, at most 0.15")


@dataclass
class Closer:
    """What the results ask of a closer."""

    records: list[ClosureRecord]
    num_distrusted: int = 0

    def similarity_map(self) -> SimilarityMap:
        return similarity_map(30)


def similarity_map(num: int) -> SimilarityMap:
    """Compare keyframes, every other frame, of which each third one shows the same."""
    rng = np.random.default_rng(0)
    index = PlaceIndex(16)
    unlike = rng.normal(size=(3, 16)).astype(np.float32)
    vectors = np.tile(unlike, (num // 3 + 1, 1))[:num]
    index.insert(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    return map_similarities(index, 2 * np.arange(num))


def truth() -> Trajectory:
    frames = np.arange(NUM_FRAMES)
    return Trajectory(
        frames, TIMES_S[:NUM_FRAMES], np.stack([ring_pose(i) for i in range(NUM_FRAMES)])
    )


@pytest.fixture(scope="module")
def closed() -> Slam:
    """Drive one lap and a quarter, and close three loops."""
    slam = chain(DRIFT)
    for a, b in CLOSED:
        assert slam.close(a, b, *true_link(a, b, DRIFT.seed))
    return slam


def loops_of(slam: Slam, records: list[ClosureRecord], *, has_truth: bool = True) -> Loops:
    chained = slam.trajectory(TIMES_S, closed=False)
    return look_back(Closer(records), slam, chained, truth() if has_truth else None)  # type: ignore[arg-type]


def read(path: Path) -> np.ndarray:
    return np.asarray(PIL.Image.open(path).convert("RGB")).astype(int)


def has_color(picture: np.ndarray, color: str, num: int = 20) -> bool:
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(picture - wanted).max(axis=-1) < 40).sum()) > num


def assert_whole(path: Path) -> None:
    """Nothing touches the border: no label is cut off."""
    pixels = read(path)
    assert pixels.shape[1] == 1200
    assert pixels.shape[0] <= 4000
    assert (pixels < 200).any()
    border = np.concatenate([pixels[:4], pixels[-4:]], axis=0), pixels[:, :4], pixels[:, -4:]
    assert all((strip == 255).all() for strip in border), path.name


# --- numbers ------------------------------------------------------------------------------------


def test_the_path_without_closures_is_the_one_from_before_them(closed: Slam) -> None:
    before = chain(DRIFT).trajectory(TIMES_S)
    after = closed.trajectory(TIMES_S, closed=False)
    np.testing.assert_allclose(after.world_from_cam, before.world_from_cam, atol=1e-9)
    assert ate_m(closed.trajectory(TIMES_S)) < 0.5 * ate_m(after)


def test_the_report_says_what_the_run_would_be_without_its_loops(closed: Slam) -> None:
    other = replace(BAD, verdict="the images do not match: 12 matches agree, need 30")
    records = [
        GOOD,
        GOOD,
        BAD,
        replace(BAD, verdict="depths differ by 4.2e-01, at most 0.2"),
        other,
    ]
    report = describe_loops(loops_of(closed, records))
    assert report is not None
    assert (report["candidates"], report["accepted"], report["distrusted"]) == (5, 2, 0)
    assert report["refused"] == {"depths differ by N, at most N": 2, "the images do not match": 1}
    without = report["trajectory_without"]["ate_sim3_m"]["rmse"]
    assert without == pytest.approx(ate_m(closed.trajectory(TIMES_S, closed=False)), rel=1e-6)
    assert [record["verdict"] for record in report["records"]] == [r.verdict for r in records]


def test_windows_between_the_ends_of_a_loop_are_surer_with_it(closed: Slam) -> None:
    report, chained = (describe_loops(loops_of(slam, [GOOD])) for slam in (closed, chain(DRIFT)))
    assert report is not None
    assert chained is not None
    last = str(len(closed.nodes) - 1)
    assert set(report["sigmas"]) == set(chained["sigmas"])
    for name in ("scale_percent", "rotation_deg", "translation"):
        assert np.all(report["sigmas"][last][name] < chained["sigmas"][last][name])
        assert np.all(np.isfinite(report["sigmas"][last][name]))


def test_the_report_is_json_without_nan(closed: Slam, tmp_path: Path) -> None:
    loops = replace(loops_of(closed, [GOOD, BAD]), sigmas={0: np.full(7, np.nan)})
    write_report(tmp_path / "report.json", {"closures": describe_loops(loops)})
    text = (tmp_path / "report.json").read_text()

    def refuse(name: str) -> None:
        raise AssertionError(name)

    report = json.loads(text, parse_constant=refuse)["closures"]
    assert report["sigmas"]["0"]["scale_percent"] is None
    assert report["records"][0]["frame_b"] == 93


def test_a_graph_without_covariance_is_warned_of_and_the_run_goes_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise DegenerateGeometryError("the pose graph has no covariance")

    monkeypatch.setattr(PoseGraph, "marginal_sigmas", fail)
    with caplog.at_level(logging.WARNING):
        loops = loops_of(chain(DRIFT, 3), [])
    assert loops.sigmas == {}
    assert "no covariance" in caplog.text
    report = describe_loops(loops)
    assert report is not None
    assert report["sigmas"] is None


def test_no_truth_no_closure_and_no_search_are_told_apart(closed: Slam) -> None:
    assert describe_loops(None) is None
    report = describe_loops(loops_of(closed, [], has_truth=False))
    assert report is not None
    assert (report["candidates"], report["refused"], report["trajectory_without"]) == (0, {}, None)


def test_the_files_of_the_run_can_be_read_again(closed: Slam, tmp_path: Path) -> None:
    write_loops(tmp_path, loops_of(closed, [GOOD, BAD]), closed)
    assert read_closures(tmp_path / "closures.json") == [GOOD, BAD]
    graph = read_g2o(tmp_path / "graph.g2o", Config().pose_graph)
    chain_links, closures = graph.links
    assert len(chain_links) == len(closed.nodes) - 1
    assert [(link.a, link.b) for link in closures] == CLOSED
    for node in closed.nodes:
        place = graph.places[node.index]
        np.testing.assert_allclose(place.matrix(), node.world_from_window.matrix(), atol=1e-6)


def test_the_summary_tells_the_loops_in_one_line(closed: Slam) -> None:
    def line(records: list[ClosureRecord], *, has_truth: bool = True) -> str:
        report = {
            "frames": {"read": 9, "unreadable": 0, "keyframes": 9},
            "windows": {"num": 2, "bridged": {}},
            "trajectory": None,
            "depth": None,
            "frames_per_second": 1.0,
            "closures": describe_loops(loops_of(closed, records, has_truth=has_truth)),
        }
        return dict(summarize(report))["loops"]

    without = ate_m(closed.trajectory(TIMES_S, closed=False))
    assert line([GOOD, BAD]) == f"1 closed of 2 candidates; ATE without them {without:.3f} m"
    assert line([GOOD, BAD], has_truth=False) == "1 closed of 2 candidates"
    assert line([BAD]) == "0 closed of 1 candidates"


def test_scales_of_windows_are_those_of_chain_graph_and_truth(closed: Slam) -> None:
    curves = scale_curves(closed.nodes, closed.trajectory(TIMES_S), truth(), (2.0, 3.0))
    assert (np.diff(curves.distances) > 0).all()
    chained = [2 * node.chained.scale for node in closed.nodes]
    moved = [3 * node.world_from_window.scale for node in closed.nodes]
    np.testing.assert_allclose(curves.chained, chained)
    np.testing.assert_allclose(curves.closed, moved)
    exact = chain(NO_DRIFT)
    curves = scale_curves(exact.nodes, exact.trajectory(TIMES_S), truth(), (1.0, 1.0))
    assert curves.truth is not None
    units = [unit_of(node.index, NO_DRIFT.seed) for node in exact.nodes]
    np.testing.assert_allclose(curves.truth, units, rtol=1e-6)
    np.testing.assert_allclose(curves.closed / curves.closed[0] * units[0], units, rtol=1e-3)


def test_few_pairs_are_chosen_from_the_whole_run_and_some_of_each_kind() -> None:
    good = [replace(GOOD, frame_a=i) for i in range(30)]
    bad = [replace(BAD, frame_a=i) for i in range(30)]
    for records, counts in (
        (good + bad, (6, 6)),
        (good + bad[:2], (10, 2)),
        (good[:1] + bad, (1, 11)),
        (good[:3] + bad[:3], (3, 3)),
        ([], (0, 0)),
    ):
        chosen = choose_pairs(records, 12)
        accepted = sum(record.is_accepted for record in chosen)
        assert (accepted, len(chosen) - accepted) == counts
        assert len({(r.frame_a, r.verdict) for r in chosen}) == len(chosen)
    frames = [record.frame_a for record in choose_pairs(good, 12)]
    assert (frames[0], frames[-1]) == (0, 29)


# --- the map of similarities --------------------------------------------------------------------


def slow_map(index: PlaceIndex, num: int, per_cell: int) -> np.ndarray:
    found = index.similarities(index.descriptors(np.arange(num)))
    cells = -(-num // per_cell)
    return np.array(
        [
            [
                found[i * per_cell : (i + 1) * per_cell, j * per_cell : (j + 1) * per_cell].max()
                for j in range(cells)
            ]
            for i in range(cells)
        ]
    )


@pytest.mark.parametrize("num", [1, 7, 150, 333])
def test_a_cell_shows_the_greatest_similarity_of_its_keyframes(
    num: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(laser_slam.places.similarity, "MAX_CELLS", 50)
    vectors = np.random.default_rng(num).normal(size=(num, 24)).astype(np.float32)
    index = PlaceIndex(24)
    index.insert(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    found = map_similarities(index, np.arange(num))
    assert found.similarities.shape[0] <= 50
    expected = slow_map(index, num, found.per_cell)
    np.testing.assert_allclose(found.similarities, expected, atol=2e-3)  # float16


def test_a_long_run_is_compared_in_part_and_its_revisit_still_shows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(laser_slam.places.similarity, "MAX_CELLS", 20)
    monkeypatch.setattr(laser_slam.places.similarity, "MAX_PAIRS", 20_000)
    lap = np.random.default_rng(0).normal(size=(500, 64)).astype(np.float32)
    index = PlaceIndex(64)
    index.insert(np.tile(lap / np.linalg.norm(lap, axis=1, keepdims=True), (2, 1)))
    shown: list[int] = []
    compare = index.similarities

    def counted(rows: np.ndarray, stop: int) -> np.ndarray:
        shown.append(len(rows))
        return compare(rows, stop)

    monkeypatch.setattr(index, "similarities", counted)
    found = map_similarities(index, np.arange(1000))
    assert sum(shown) == 1000 // 25
    assert found.per_cell == 50
    is_revisit = np.abs(np.subtract.outer(np.arange(20), np.arange(20))) % 10 == 0
    assert (found.similarities[is_revisit] > 0.9).all()
    assert (found.similarities[~is_revisit] < 0.7).all()


def test_no_keyframe_gives_an_empty_map() -> None:
    found = map_similarities(PlaceIndex(8), np.zeros(0, np.int64))
    assert found.similarities.shape == (0, 0)


# --- pictures -----------------------------------------------------------------------------------


def test_all_pictures_of_a_run_with_loops_are_whole(closed: Slam, tmp_path: Path) -> None:
    (tmp_path / "windows").mkdir()
    files = WindowFiles(tmp_path)
    for window in (0, 18):
        files.save(window, prediction_of(window, DRIFT), black())
    long = replace(BAD, verdict="a reason of many words " * 30)
    loops = loops_of(closed, [GOOD, BAD, long])
    draw_loops(tmp_path, loops, closed.trajectory(TIMES_S), closed.nodes, files)
    names = {path.name for path in tmp_path.glob("*.png")}
    assert names == {"loops.png", "loop_pairs.png", "similarity.png", "scales.png"}
    for name in names:
        assert_whole(tmp_path / name)
    for name in ("loops.png", "loop_pairs.png"):
        assert has_color(read(tmp_path / name), ACCEPTED)
        assert has_color(read(tmp_path / name), REJECTED)


@pytest.mark.parametrize("num_windows", [1, 4])
def test_a_run_without_candidates_or_truth_has_its_pictures_too(
    num_windows: int, tmp_path: Path
) -> None:
    slam = chain(DRIFT, num_windows)
    loops = loops_of(slam, [], has_truth=False)
    draw_loops(tmp_path, loops, slam.trajectory(TIMES_S), slam.nodes, WindowFiles(tmp_path))
    names = {path.name for path in tmp_path.glob("*.png")}
    assert names == {"similarity.png", "scales.png"}
    for name in names:
        assert_whole(tmp_path / name)


def test_a_single_keyframe_that_stands_in_its_truth_breaks_no_picture(tmp_path: Path) -> None:
    slam = Slam(Config())
    slam.add(ring_prediction(np.arange(1)), black(1))
    one = slam.trajectory(TIMES_S)
    loops = Loops([], 0, similarity_map(1), one, one, None, {})
    draw_loops(tmp_path, loops, one, slam.nodes, WindowFiles(tmp_path))
    assert len(list(tmp_path.glob("*.png"))) == 2


@pytest.mark.parametrize("shape", [(1.0, 1.0), (1.0, 0.02), (0.0, 1.0), (1e4, 3e3)])
@pytest.mark.parametrize("has_truth", [True, False])
def test_paths_of_any_shape_and_many_rejections_fit(
    shape: tuple[float, float], has_truth: bool, tmp_path: Path
) -> None:
    angle = np.linspace(0, 9, 80)
    poses = np.tile(np.eye(4), (80, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = shape[0] * np.cos(angle), shape[1] * np.sin(angle)
    path = Trajectory(np.arange(80), np.arange(80.0), poses)
    pairs = frame_pairs([(i, (7 * i) % 80) for i in range(79)])
    unknown = frame_pairs([(0, 500)])  # a frame without pose
    paths = LoopPaths(path, path, path if has_truth else None, unknown, pairs)
    loops_picture(tmp_path / "loops.png", paths)
    assert_whole(tmp_path / "loops.png")
    assert has_color(read(tmp_path / "loops.png"), REJECTED, 5)


@pytest.mark.parametrize("size", [(120, 400), (90, 120), (160, 90)])
def test_a_sheet_frames_its_pairs_by_verdict(size: tuple[int, int], tmp_path: Path) -> None:
    grey = np.full((*size, 3), 90, np.uint8)
    for is_accepted, color, other in ((True, ACCEPTED, REJECTED), (False, REJECTED, ACCEPTED)):
        pair = ImagePair((grey, grey), (3, 99_999), is_accepted, "what was measured " * 20)
        pairs_picture(tmp_path / "pairs.png", [pair] * 12, "12 of 99 candidates")
        assert_whole(tmp_path / "pairs.png")
        sheet = read(tmp_path / "pairs.png")
        assert has_color(sheet, color, 5000)
        assert not has_color(sheet, other)
        assert (np.abs(sheet - 90).max(axis=-1) < 3).mean() > 0.3
    pairs_picture(tmp_path / "none.png", [], "no candidates")
    assert read(tmp_path / "none.png").shape[1] == 1200


@pytest.mark.parametrize("num", [0, 1, 2, 30, 1300])
def test_similarity_maps_of_any_size_are_labelled_by_frame(num: int, tmp_path: Path) -> None:
    found = similarity_map(num)
    last = max(0, 2 * num - 2)
    accepted, rejected = frame_pairs([(0, last)] if num else []), frame_pairs([])
    path = tmp_path / "map.png"
    similarity_picture(path, found.similarities, found.frames, found.per_cell, accepted, rejected)
    assert_whole(path)
    assert has_color(read(path), "#35d07f", 10) == bool(num)


def test_unknown_scales_leave_a_gap(tmp_path: Path) -> None:
    distances = np.arange(4.0)
    unknown = np.array([1.0, np.nan, np.nan, 1.1])
    ones = np.ones(4)
    scales_picture(tmp_path / "a.png", ScaleCurves(distances, ones, ones, unknown))
    nothing = np.zeros(0)
    scales_picture(tmp_path / "b.png", ScaleCurves(nothing, nothing, nothing, nothing))
    scales_picture(tmp_path / "c.png", ScaleCurves(distances, ones, 20 * ones, None))
    for path in tmp_path.glob("*.png"):
        assert_whole(path)
