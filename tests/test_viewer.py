"""The viewer: what a recording holds, where its points are, and that no run depends on it."""

import json
import logging
import subprocess
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ring import (
    DISTANCES,
    NORMALS,
    NUM_WINDOWS,
    SIZE,
    TIMES_S,
    WINDOW,
    Array,
    Drift,
    black,
    chain,
    prediction_of,
    true_link,
    unit_of,
)
from typer.testing import CliRunner

from laser_slam.cli import app
from laser_slam.closures import ClosureRecord, write_closures
from laser_slam.config import Config, FusionConfig, ViewerConfig, dump_config
from laser_slam.dependencies import import_rerun
from laser_slam.errors import DependencyError, LaserSlamError, RunFolderError
from laser_slam.export import write_ply, write_tum
from laser_slam.pose_graph import read_g2o, write_g2o
from laser_slam.predicting.manifest import save_frames
from laser_slam.results import CHAINED_FILE
from laser_slam.sim3 import Sim3
from laser_slam.slam import Slam
from laser_slam.store import WindowFiles
from laser_slam.types import Cloud, Layers, Submap, Trajectory
from laser_slam.viewer import BestEffortViewer, FileSink, NullViewer, RerunViewer
from laser_slam.viewer.pictures import (
    BORDER,
    DEPTH_STEPS,
    NUM_SCALES,
    class_colors,
    encode_depth,
    layer_classes,
)
from laser_slam.viewer.points import PointBudget, sample_points
from laser_slam.viewing import live_viewer, view_run

reading = pytest.importorskip("rerun.chunk", reason="rerun is not installed, or cannot read")

DRIFT = Drift()
LOOPS = [(1, 19), (3, 21), (4, 22)]  # windows that see one place
SMALL = ViewerConfig(points_per_window=300, image_width=40)


@dataclass(frozen=True)
class Row:
    """What was logged to an entity at once."""

    frame: int | None  # None: static
    time_s: float | None
    values: dict[str, list]


def read(path: Path) -> dict[str, list[Row]]:
    """Read a recording: the rows of each entity, in the order in which they were logged."""
    rows = defaultdict(list)
    for chunk in reading.RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch().to_pydict()
        names = {name for name in batch if ":" in name or name in ("frame", "time")}
        order = batch["rerun.controls.RowId"] if "rerun.controls.RowId" in batch else None
        for i in range(chunk.num_rows):
            values = {name: batch[name][i] for name in names if batch[name][i] is not None}
            frame, time = values.pop("frame", None), values.pop("time", None)
            time_s = None if time is None else time.total_seconds()
            key = order[i] if order else i
            rows[chunk.entity_path.lstrip("/")].append((key, Row(frame, time_s, values)))
    return {entity: [row for _, row in sorted(some, key=_age)] for entity, some in rows.items()}


def _age(item: tuple[object, Row]) -> object:
    return item[0]


def places_at_the_end(rows: dict[str, list[Row]]) -> dict[str, Sim3]:
    """Return the last world_from_window of each window, as rerun documents its transforms."""
    out = {}
    for row in rows["world/places"]:
        (name,) = row.values["Transform3D:child_frame"]
        assert row.values["Transform3D:parent_frame"] == ["tf#/world"]
        scale = np.array(row.values["Transform3D:scale"][0])
        assert (scale == scale[0]).all()
        rotation = np.reshape(row.values["Transform3D:mat3x3"][0], (3, 3)).T  # by columns
        u, _, vt = np.linalg.svd(rotation)
        translation = np.array(row.values["Transform3D:translation"][0])
        assert np.allclose(u @ vt, rotation, atol=1e-6)
        out[name] = Sim3(scale[0], u @ vt, translation)
    return out


def points_of(rows: dict[str, list[Row]], window: int) -> Array:
    """Return the points of a window that are seen at the end, in its own frame."""
    some = [
        row.values["Points3D:positions"]
        for row in rows[f"world/windows/{window:06d}"]
        if "Points3D:positions" in row.values
    ]
    return np.array(some[-1])


def to_the_walls_m(world: Array) -> Array:
    """Return how far points in world units are from the room's surfaces, in metres."""
    metres = world * unit_of(0)
    return np.abs(metres @ NORMALS.T - DISTANCES).min(axis=1)


def submap_of(slam: Slam, window: int) -> Submap:
    colors = np.random.default_rng(window).integers(0, 256, (WINDOW, *SIZE, 3), dtype=np.uint8)
    submap = slam.nodes[window].submap(prediction_of(window, DRIFT), colors)
    owned = submap.prediction.frames >= slam.nodes[window].owned[0]  # as long as it is the last
    return replace(submap, is_owned=owned)


def record_of(a: int, b: int, verdict: str = "accepted") -> ClosureRecord:
    frame_a, frame_b = int(chained.nodes[a].frames[0]), int(chained.nodes[b].frames[0])
    return ClosureRecord(a, b, frame_a, frame_b, 0.9, verdict)


def show(path: Path, num: int, config: ViewerConfig = SMALL, layers: Layers | None = None) -> None:
    """Record the first windows of the drive."""
    viewer = RerunViewer(FileSink(path), config, FUSION)
    for window in range(num):
        submap = submap_of(chained, window)
        viewer.window(submap, layers, TIMES_S[submap.prediction.frames])
    viewer.close()


FUSION = FusionConfig(max_range=20)
chained = chain(DRIFT)


def closed() -> Slam:
    slam = chain(DRIFT)
    for a, b in LOOPS:
        slam.close(a, b, *true_link(a, b, DRIFT.seed))
    assert slam.optimised is not None
    assert slam.optimised.is_trusted.all()  # the first one alone is not
    return slam


# What a recording holds


def test_points_are_where_the_room_is_once_their_window_is_placed(tmp_path: Path) -> None:
    slam = chain(Drift(0, 0), 6)
    viewer = RerunViewer(FileSink(tmp_path / "a.rrd"), SMALL, FUSION)
    for window in range(6):
        submap = slam.nodes[window].submap(prediction_of(window), black())
        viewer.window(submap, None, TIMES_S[submap.prediction.frames])
    viewer.close()
    rows = read(tmp_path / "a.rrd")
    places = places_at_the_end(rows)
    assert len({round(place.scale, 3) for place in places.values()}) == 6  # units differ
    for window in range(6):
        world = places[f"window {window}"].apply(points_of(rows, window))
        assert len(world) > 100
        assert to_the_walls_m(world).max() < 1e-3


def test_a_closure_moves_windows_and_logs_no_point_again(tmp_path: Path) -> None:
    after = [node.world_from_window for node in closed().nodes]
    viewer = RerunViewer(FileSink(tmp_path / "a.rrd"), SMALL, FUSION)
    for window in range(NUM_WINDOWS):
        submap = submap_of(chained, window)
        viewer.window(submap, None, TIMES_S[submap.prediction.frames])
        viewer.loops([node.world_from_window for node in chained.nodes[: window + 1]], [])
    viewer.loops(after, [record_of(*loop) for loop in LOOPS])
    viewer.close()
    rows = read(tmp_path / "a.rrd")
    places = places_at_the_end(rows)
    for window in range(NUM_WINDOWS):
        drawn = [r for r in rows[f"world/windows/{window:06d}"] if "Points3D:positions" in r.values]
        assert len(drawn) == 1
        points = points_of(rows, window)
        shown, right = places[f"window {window}"].apply(points), after[window].apply(points)
        unit = np.median(np.linalg.norm(points, axis=1)) * after[window].scale
        assert np.abs(shown - right).max() < 5 * SMALL.move_tolerance * unit
    moved = rows["world/places"][NUM_WINDOWS:]
    assert len(moved) > NUM_WINDOWS / 2
    assert {row.frame for row in moved} == {int(chained.nodes[-1].frames[-1])}


def test_a_window_that_hardly_moves_is_not_logged_again(tmp_path: Path) -> None:
    viewer = RerunViewer(FileSink(tmp_path / "a.rrd"), SMALL, FUSION)
    submap = submap_of(chained, 0)
    viewer.window(submap, None, TIMES_S[submap.prediction.frames])
    for scale in (1.001, 1.002, 1.2):
        viewer.loops([Sim3(scale) @ submap.world_from_window], [])
    viewer.close()
    rows = read(tmp_path / "a.rrd")
    assert len(rows["world/places"]) == 2
    assert places_at_the_end(rows)["window 0"].scale == pytest.approx(
        1.2 * submap.world_from_window.scale
    )


def test_each_frame_is_shown_once_at_its_own_time(tmp_path: Path) -> None:
    show(tmp_path / "a.rrd", 4)
    rows = read(tmp_path / "a.rrd")
    for entity in ("frame/depth", "frame/confidence"):
        frames = [row.frame for row in rows[entity]]
        assert frames == list(range(int(chained.nodes[3].frames[-1]) + 1))
        assert [row.time_s for row in rows[entity]] == pytest.approx(TIMES_S[frames])
    cameras = [row for row in rows["world/camera"] if "Transform3D:mat3x3" in row.values]
    path = chained.trajectory(TIMES_S)
    for row in cameras[:5]:
        center = row.values["Transform3D:translation"][0]
        assert center == pytest.approx(path.world_from_cam[row.frame, :3, 3], abs=1e-5)


def test_images_and_depth_are_small_and_right(tmp_path: Path) -> None:
    show(tmp_path / "a.rrd", 1, SMALL.model_copy(update={"image_width": 20}))
    rows = read(tmp_path / "a.rrd")
    row = next(row for row in rows["frame/depth"] if row.frame == 3)
    blob = np.frombuffer(bytes(row.values["EncodedDepthImage:blob"][0]), np.uint8)
    steps = cv2.imdecode(blob, cv2.IMREAD_UNCHANGED)
    assert steps.shape == (12, 20)
    assert steps.dtype == np.uint16
    (meter,) = row.values["EncodedDepthImage:meter"]
    depth = prediction_of(0, DRIFT).depth[3][::2, ::2]
    assert steps / meter == pytest.approx(depth, abs=0.51 / meter)
    lens = next(r for r in rows["world/camera"] if "Pinhole:resolution" in r.values)
    assert lens.values["Pinhole:resolution"][0] == [20, 12]


def test_unknown_depth_is_zero_and_far_depth_does_not_wrap() -> None:
    depth = np.array([[np.nan, -1.0, np.inf], [1e9, 1.0, 2.0]], np.float32)
    steps = cv2.imdecode(np.frombuffer(encode_depth(depth, 3, 1.0), np.uint8), -1)
    assert steps.tolist() == [[0, 0, 0], [65535, DEPTH_STEPS, 2 * DEPTH_STEPS]]


def test_layers_are_coloured_by_the_logarithm_of_their_scale(tmp_path: Path) -> None:
    labels = np.repeat(np.array([[0, 1, 2, 3, 4]], np.uint16), 3, axis=1)
    classes = layer_classes(labels, np.array([1.0, 1.1, 1 / 1.1, 9.0]), 99)[0, 1::3]
    middle = (NUM_SCALES + 1) // 2
    assert classes.tolist() == [0, middle, classes[2], 2 * middle - classes[2], NUM_SCALES]
    assert classes[2] > middle
    assert (layer_classes(labels, np.ones(4), 99) == BORDER).sum() == 4
    names = dict((number, name) for number, name, _ in class_colors())
    assert names[middle] == "x 1.000"
    whole = np.ones((WINDOW, *SIZE), np.uint16)
    layers = Layers(
        whole, np.arange(WINDOW + 1), np.full(WINDOW, 1.1), np.ones(WINDOW, np.int64),
        np.zeros((0, 2)),
    )  # fmt: skip
    show(tmp_path / "a.rrd", 1, layers=layers)
    shown = [r for r in read(tmp_path / "a.rrd")["frame/layers"] if r.frame is not None]
    assert len(shown) == WINDOW
    assert set(shown[0].values["SegmentationImage:buffer"][0]) == {int(classes[2])}


def test_frames_have_clouds_of_their_own_where_the_scene_moves(tmp_path: Path) -> None:
    show(tmp_path / "a.rrd", 2, SMALL.model_copy(update={"points_per_frame": 50}))
    rows = read(tmp_path / "a.rrd")
    clouds = [row for row in rows["world/frame"] if "Points3D:positions" in row.values]
    assert [row.frame for row in clouds] == list(range(WINDOW + 5))
    assert max(len(row.values["Points3D:positions"]) for row in clouds) == 50
    show(tmp_path / "b.rrd", 2)
    assert "world/frame" not in read(tmp_path / "b.rrd")


def test_candidates_join_their_cameras_accepted_apart_from_rejected(tmp_path: Path) -> None:
    viewer = RerunViewer(FileSink(tmp_path / "a.rrd"), SMALL, FUSION)
    for window in range(NUM_WINDOWS):
        submap = submap_of(chained, window)
        viewer.window(submap, None, TIMES_S[submap.prediction.frames])
    places = [node.world_from_window for node in chained.nodes]
    right, wrong = record_of(*LOOPS[0]), record_of(*LOOPS[1], "3 inliers, need 30")
    viewer.loops(places, [right, wrong])
    viewer.loops(places, [right, wrong])  # nothing new
    viewer.loops(places, [replace(right, verdict="the pose graph distrusts it"), wrong])
    viewer.close()
    rows = read(tmp_path / "a.rrd")
    accepted, rejected = rows["world/closures/accepted"], rows["world/closures/rejected"]
    assert [len(row.values["LineStrips3D:strips"]) for row in accepted] == [1, 0]
    assert [len(row.values["LineStrips3D:strips"]) for row in rejected] == [1, 2]
    ends = accepted[0].values["LineStrips3D:strips"][0]
    path = chained.trajectory(TIMES_S).world_from_cam[:, :3, 3]
    unit = np.linalg.norm(np.ptp(path, axis=0))
    assert np.linalg.norm(ends[0] - path[right.frame_a]) < 0.02 * unit
    assert np.linalg.norm(ends[1] - path[right.frame_b]) < 0.02 * unit
    events = [row.values["TextLog:text"][0] for row in rows["events"]]
    assert any("3 inliers" in text for text in events)
    assert sum("distrusts" in text for text in events) == 1


def test_a_candidate_between_frames_that_were_never_shown_is_only_told(tmp_path: Path) -> None:
    viewer = RerunViewer(FileSink(tmp_path / "a.rrd"), SMALL, FUSION)
    submap = submap_of(chained, 0)
    viewer.window(submap, None, TIMES_S[submap.prediction.frames])
    viewer.loops([submap.world_from_window], [record_of(*LOOPS[0])])
    viewer.close()
    rows = read(tmp_path / "a.rrd")
    assert rows["world/closures/accepted"][0].values["LineStrips3D:strips"] == []
    assert len(rows["events"]) == 1


def test_only_frame_and_time_are_timelines(tmp_path: Path) -> None:
    show(tmp_path / "a.rrd", 1)
    chunks = reading.RrdReader(tmp_path / "a.rrd").stream().to_chunks()
    assert {name for chunk in chunks for name in chunk.timeline_names} == {"frame", "time"}
    assert len(reading.RrdReader(tmp_path / "a.rrd").blueprints()) == 1


# How much is shown


def test_points_of_all_windows_stay_within_the_budget(tmp_path: Path) -> None:
    limit = 1000
    show(tmp_path / "a.rrd", 12, SMALL.model_copy(update={"max_points": limit}))
    rows = read(tmp_path / "a.rrd")
    counts = [len(points_of(rows, window)) for window in range(12)]
    assert limit / 3 < sum(counts) <= limit
    assert min(counts) > 0
    drawn = [row for window in range(12) for row in rows[f"world/windows/{window:06d}"]]
    stored = sum(len(row.values.get("Points3D:positions", [])) for row in drawn)
    assert stored <= 4 * limit


def test_thinning_keeps_every_second_point_of_each_window() -> None:
    budget = PointBudget(8, 20)
    windows = [np.full((8, 3), i, np.float32) for i in range(3)]
    colors = np.zeros((8, 3), np.uint8)
    assert list(budget.add(0, (windows[0], colors))) == [0]
    assert list(budget.add(1, (windows[1], colors))) == [1]
    anew = budget.add(2, (windows[2], colors))
    assert {i: len(points) for i, (points, _) in anew.items()} == {0: 4, 1: 4, 2: 4}
    assert budget.per_window == 4


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_the_same_pixels_are_drawn_in_any_unit(factor: float) -> None:
    submap = submap_of(chained, 2)
    window = submap.prediction
    grown = replace(
        submap,
        prediction=replace(
            window,
            depth=(window.depth * np.float32(factor)),
            window_from_cam=window.window_from_cam
            * np.block([[np.ones((3, 3)), np.full((3, 1), factor)], [np.ones((1, 4))]]),
        ),
    )
    rows = np.arange(WINDOW)
    points, colors = sample_points(submap, rows, 200, FUSION, 1.0)
    scaled, same_colors = sample_points(grown, rows, 200, FUSION, factor)
    assert (colors == same_colors).all()
    assert scaled / factor == pytest.approx(points, rel=1e-3, abs=1e-3)


def test_no_point_hangs_between_a_pole_and_the_wall_behind_it() -> None:
    submap = submap_of(chained, 0)
    depth = np.full((WINDOW, *SIZE), 4.0, np.float32)
    depth[:, :, 18:22] = 1.0
    depth[:, :, 22] = 2.5  # depth maps blend both sides
    prediction = replace(submap.prediction, depth=depth)
    points, _ = sample_points(
        replace(submap, prediction=prediction), np.array([0]), 10_000, FUSION, 4.0
    )
    assert set(np.round(points[:, 2], 3).tolist()) == {1.0, 4.0}


# Runs and their folders


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run with three closures and a refused candidate."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "windows").mkdir()
    slam, files = Slam(Config()), WindowFiles(folder)
    for window in range(NUM_WINDOWS):
        slam.add(*files.save(window, prediction_of(window, DRIFT), black()))
    before = slam.trajectory(TIMES_S)
    for a, b in LOOPS:
        slam.close(a, b, *true_link(a, b, DRIFT.seed))
    records = [record_of(*loop) for loop in LOOPS]
    records.insert(1, record_of(2, 20, "too few matches"))
    (folder / "config.yaml").write_text(dump_config(Config(viewer=SMALL)))
    write_closures(folder / "closures.json", records)
    write_g2o(folder / "graph.g2o", slam.pose_graph())
    write_tum(folder / "trajectory_tum.txt", _every_frame(slam.trajectory(TIMES_S)))
    write_tum(folder / CHAINED_FILE, _every_frame(before))
    points = np.random.default_rng(0).normal(size=(500, 3))
    colors = np.full((500, 3), 90, np.uint8)
    write_ply(folder / "map.ply", Cloud(points, colors, np.ones(500, np.float32)))
    return folder


def _every_frame(path: Trajectory) -> Trajectory:
    assert (path.frames == np.arange(len(path.frames))).all()
    return path


def test_a_finished_run_is_told_again_and_ends_as_it_did(run: Path, tmp_path: Path) -> None:
    assert view_run(run, FileSink(tmp_path / "a.rrd")) == NUM_WINDOWS
    rows = read(tmp_path / "a.rrd")
    places = places_at_the_end(rows)
    graph = read_g2o(run / "graph.g2o", Config().pose_graph)
    for window, world_from_window in graph.places.items():
        shown = places[f"window {window}"].matrix()
        assert shown == pytest.approx(world_from_window.matrix(), abs=2e-6)
    second_closure = chained.nodes[LOOPS[1][1] + 1].frames[-1]  # by then two agree
    moves = [row.frame for row in rows["world/places"]]
    assert sum(frame == second_closure for frame in moves) > NUM_WINDOWS / 3
    assert [len(r.values["LineStrips3D:strips"]) for r in rows["world/closures/accepted"]][-1] == 3
    assert len(rows["results/map"][0].values["Points3D:positions"]) == 500
    path, chained_path = (
        np.array(rows[name][0].values["LineStrips3D:strips"][0])
        for name in ("results/path", "results/path_without_loops")
    )
    assert len(path) == len(chained_path)
    assert np.abs(path - chained_path).max() > 0.1


def test_a_run_that_was_broken_off_is_shown_as_far_as_it_came(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    (folder / "windows").mkdir(parents=True)
    (folder / "config.yaml").write_bytes((run / "config.yaml").read_bytes())
    for window in range(3):
        name = f"windows/{window:06d}.npz"
        (folder / name).write_bytes((run / name).read_bytes())
    assert view_run(folder, FileSink(tmp_path / "a.rrd")) == 3
    rows = read(tmp_path / "a.rrd")
    assert len(places_at_the_end(rows)) == 3
    assert "results/map" not in rows
    assert [row.time_s for row in rows["frame/depth"][:3]] == pytest.approx([0.0, 0.1, 0.2])
    save_frames(folder, 7 + TIMES_S, [])  # it broke off later, when all had been predicted
    view_run(folder, FileSink(tmp_path / "b.rrd"))
    times_s = [row.time_s for row in read(tmp_path / "b.rrd")["frame/depth"][:3]]
    assert times_s == pytest.approx([7.0, 7.1, 7.2])


def test_the_command_writes_a_recording_where_there_is_no_display(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = CliRunner().invoke(app, ["view", str(run), "--quiet"])
    assert done.exit_code == 0, done.output
    assert f"rerun {run / 'run.rrd'}" in done.output.replace("\n", "")
    assert len(places_at_the_end(read(run / "run.rrd"))) == NUM_WINDOWS
    (run / "run.rrd").unlink()


def test_a_file_and_a_page_at_once_are_refused(run: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["view", str(run), "--save", str(tmp_path / "a"), "--serve"])
    assert done.exit_code == 1
    assert "choose one" in done.output


@pytest.mark.parametrize("is_run", [False, True])
def test_a_folder_without_a_run_is_refused_in_words(tmp_path: Path, is_run: bool) -> None:
    if is_run:
        (tmp_path / "config.yaml").write_text(dump_config(Config()))
    with pytest.raises(RunFolderError, match="no windows to show" if is_run else "give a run"):
        view_run(tmp_path, FileSink(tmp_path / "a.rrd"))
    assert not (tmp_path / "a.rrd").exists()


# What no run depends on


def test_a_full_disk_ends_the_viewing_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("the system has no /dev/full")
    viewer = BestEffortViewer(RerunViewer(FileSink(Path("/dev/full"), replace=True), SMALL, FUSION))
    with caplog.at_level(logging.WARNING):
        for window in range(3):
            submap = submap_of(chained, window)
            viewer.window(submap, None, TIMES_S[submap.prediction.frames])
        viewer.close()
    assert len(caplog.records) == 1
    assert "No space left" in caplog.text
    assert "the run goes on" in caplog.text


def test_a_recording_that_cannot_be_written_is_an_error_where_it_was_asked_for(
    run: Path, tmp_path: Path
) -> None:
    with pytest.raises(RunFolderError, match=r"cannot write the recording .*No such file"):
        view_run(run, FileSink(tmp_path / "missing" / "a.rrd"))


def test_a_file_that_is_there_is_replaced_only_by_force(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "thesis.rrd"
    path.write_text("years")
    arguments = ["view", str(run), "--save", str(path), "--quiet"]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 1
    assert "is there already; replace it with --force" in refused.output
    assert len(refused.output.splitlines()) == 1
    with pytest.raises(RunFolderError, match="is there already"):
        view_run(run, FileSink(path))
    assert path.read_text() == "years"
    done = CliRunner().invoke(app, [*arguments, "--force"])
    assert done.exit_code == 0, done.output
    assert len(places_at_the_end(read(path))) == NUM_WINDOWS


def test_a_file_that_cannot_be_opened_stays(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "thesis.rrd"
    path.write_text("years")
    sink = FileSink(path, replace=True)

    def refuse(_path: Path) -> None:
        raise RuntimeError("Permission denied, path: thesis.rrd")

    monkeypatch.setattr(sink.stream, "save", refuse)
    with pytest.raises(RunFolderError, match="Permission denied"):
        view_run(run, sink)
    assert path.read_text() == "years"


def test_other_failures_are_not_hidden() -> None:
    class Broken(NullViewer):
        def close(self) -> None:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        BestEffortViewer(Broken()).close()


def test_a_run_without_a_display_is_recorded_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    folder = tmp_path / "run"
    viewer = live_viewer(folder, Config(viewer=SMALL))
    assert not folder.exists()  # the run makes its folder itself, and refuses one with files
    folder.mkdir()
    submap = submap_of(chained, 0)
    viewer.window(submap, None, TIMES_S[submap.prediction.frames])
    viewer.close()
    assert (folder / "run.rrd").stat().st_size > 1000


def test_rerun_is_loaded_only_for_a_viewer_that_shows() -> None:
    code = (
        "import sys, json; import laser_slam.viewing; "
        "from laser_slam.viewer import NullViewer; NullViewer().loops([], []); "
        "print(json.dumps([m for m in sys.modules if m.split('.')[0].startswith('rerun')]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert json.loads(done.stdout) == []


def test_a_missing_rerun_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import_rerun.cache_clear()
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(DependencyError, match=r"pip install 'laser-slam\[viewer\]'"):
        FileSink(tmp_path / "a.rrd")
    assert issubclass(DependencyError, LaserSlamError)
    import_rerun.cache_clear()
