"""A whole run over a corridor whose every answer is known."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from corridor import Corridor, TrueBackbone
from quick_runs import leave_pictures_out

import laser_slam.pipeline
from laser_slam.config import Config, load_config
from laser_slam.errors import DatasetError, RunFolderError
from laser_slam.pipeline import Pipeline
from laser_slam.rescoring import rescore
from laser_slam.results import Findings, Results
from laser_slam.sim3 import Sim3
from laser_slam.types import Cloud, Layers, Submap, Trajectory, WindowStatus
from laser_slam.viewer import NullViewer
from laser_slam.viewer.base import CandidateRecord

NUM_FRAMES = 36
CONFIG = load_config(
    assignments=["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"]
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Run once, with everything: unreadable frames, a failed window."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    backbone = TrueBackbone(statuses={2: WindowStatus.FAILED})
    return Pipeline(
        Corridor(NUM_FRAMES, unreadable=(4, 5)), CONFIG, folder, backbone=backbone
    ).run()


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes seconds and is drawn in other tests."""
    leave_pictures_out(monkeypatch)


def run(
    folder: Path, backbone: TrueBackbone, dataset: Corridor | None = None, config: Config = CONFIG
) -> Results:
    return Pipeline(dataset or Corridor(NUM_FRAMES), config, folder, backbone=backbone).run()


def outcome(folder: Path) -> tuple[bytes, bytes]:
    return (folder / "trajectory_kitti.txt").read_bytes(), (folder / "map.ply").read_bytes()


def test_every_frame_of_the_input_has_a_finite_pose(whole: Results) -> None:
    assert np.array_equal(whole.trajectory.frames, np.arange(NUM_FRAMES))
    assert np.isfinite(whole.trajectory.world_from_cam).all()
    assert len((whole.folder / "trajectory_kitti.txt").read_text().splitlines()) == NUM_FRAMES
    assert len((whole.folder / "trajectory_tum.txt").read_text().splitlines()) == NUM_FRAMES


def test_the_run_folder_holds_all_that_was_promised(whole: Results) -> None:
    names = {str(path.relative_to(whole.folder)) for path in whole.folder.rglob("*")}
    pictures = ["trajectory", "drift", "map_above", "map_bird", "map_driver", "depth", "stages"]
    assert names >= {f"pictures/{name}.png" for name in pictures}
    assert names >= {"pictures/similarity.png", "pictures/scales.png"}
    assert names >= {"config.yaml", "run.log", "report.json", "map.ply", "windows/000000.npz"}
    assert names >= {"closures.json", "graph.g2o", "trajectory_without_loops_tum.txt"}
    assert not [name for name in names if "partial" in name]
    assert load_config(file=whole.folder / "config.yaml") == CONFIG


def test_the_report_counts_what_was_degraded_and_warns_once_each(whole: Results) -> None:
    report = json.loads((whole.folder / "report.json").read_text())
    assert report["frames"]["read"] == NUM_FRAMES
    assert report["frames"]["unreadable"] == 2
    assert list(report["windows"]["bridged"]) == ["2", "3"]
    assert sum("bridged" in warning for warning in report["warnings"]) == 2
    assert sum("cannot be read" in warning for warning in report["warnings"]) == 2
    assert "window 2 is bridged" in (whole.folder / "run.log").read_text()


def test_the_report_names_times_memory_calibration_and_settings(whole: Results) -> None:
    report = json.loads((whole.folder / "report.json").read_text())
    assert {"read", "predict", "register", "fuse", "pictures"} <= set(report["seconds"]["wall"])
    assert report["frames_per_second"] > 0
    assert report["peak_memory_mib"] > 50
    assert report["sequence"]["intrinsics_source"] == "the corridor's plan"
    assert report["sequence"]["intrinsics"]["fx"] == pytest.approx(76.27, abs=0.01)
    assert report["settings"]["windows"]["size"] == 8


def test_a_run_that_looks_for_no_loops_says_so_and_leaves_no_files_of_them(
    tmp_path: Path, no_pictures: None
) -> None:
    settings = load_config(assignments=["windows.size=8", "closures.enabled=false"])
    results = run(tmp_path / "run", TrueBackbone(), config=settings)
    assert results.report["closures"] is None
    assert not (results.folder / "closures.json").exists()


def test_a_run_without_candidates_counts_none(whole: Results) -> None:
    closures = json.loads((whole.folder / "report.json").read_text())["closures"]
    assert (closures["candidates"], closures["accepted"], closures["records"]) == (0, 0, [])
    without, found = closures["trajectory_without"], whole.report["trajectory"]
    assert without["ate_sim3_m"]["rmse"] == pytest.approx(found["ate_sim3_m"]["rmse"])


def test_a_run_on_true_predictions_finds_the_true_path_and_depth(
    tmp_path: Path, no_pictures: None
) -> None:
    """Only float16 depth and 8-bit confidence stand between the backbone's truth and the map."""
    report = run(tmp_path / "run", TrueBackbone()).report
    assert report["trajectory"]["ate_sim3_m"]["rmse"] < 2e-3
    assert report["depth"]["by_trajectory_scale"]["abs_rel"] < 1e-3
    assert report["depth"]["by_median_ratio"]["coverage"] == 1.0
    assert report["windows"]["bridged"] == {}


def test_a_fused_map_lies_on_the_walls(tmp_path: Path, no_pictures: None) -> None:
    results = run(tmp_path / "run", TrueBackbone())
    scale = results.report["trajectory"]["scale"]
    metres = results.cloud.points * scale  # the first camera is the corridor's origin
    to_floor = np.abs(metres[:, 1] - 1.6)
    to_ceiling = np.abs(metres[:, 1] + 3.0)
    to_walls = np.abs(np.abs(metres[:, 0]) - 4.0)
    to_end = np.abs(metres[:, 2] - 60.0)
    distance = np.min([to_floor, to_ceiling, to_walls, to_end], axis=0)
    assert len(metres) > 1000
    assert np.median(distance) < 0.01
    assert np.quantile(distance, 0.99) < 0.1


def test_without_truth_there_are_no_scores_and_no_zeros(tmp_path: Path, no_pictures: None) -> None:
    dataset = Corridor(NUM_FRAMES, with_truth=False)
    report = run(tmp_path / "run", TrueBackbone(), dataset).report
    assert report["trajectory"] is None
    assert report["depth"] is None
    assert not (tmp_path / "run" / "truth_tum.txt").exists()


@pytest.mark.parametrize("status", [WindowStatus.FAILED, WindowStatus.STATIC])
def test_a_run_that_sees_nothing_at_all_still_ends_with_a_pose_for_every_frame(
    tmp_path: Path, status: WindowStatus
) -> None:
    """With pictures: they too must bear an empty map and a path of one point."""
    backbone = TrueBackbone(statuses=dict.fromkeys(range(99), status))
    results = run(tmp_path / "run", backbone, Corridor(12))
    assert len(results.trajectory.frames) == 12
    assert len(results.cloud.points) == 0
    assert results.report["trajectory"]["reason"] is not None
    assert results.report["trajectory"]["ate_sim3_m"] is None
    warnings = "; ".join(results.report["warnings"])
    assert "window 0 has no depth" in warnings
    assert "the map is empty" in warnings


def test_a_broken_off_run_ends_as_one_that_was_not(tmp_path: Path, no_pictures: None) -> None:
    run(tmp_path / "whole", TrueBackbone())
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "broken", TrueBackbone(interrupt_at=3))
    assert len(list((tmp_path / "broken" / "windows").glob("*.npz"))) == 3
    again = TrueBackbone()
    run(tmp_path / "broken", again)
    whole_windows = len(list((tmp_path / "whole" / "windows").glob("*.npz")))
    assert again.calls == whole_windows - 3
    assert outcome(tmp_path / "broken") == outcome(tmp_path / "whole")


def test_a_backbone_that_remembers_is_asked_again_for_what_it_must_remember(
    tmp_path: Path, no_pictures: None
) -> None:
    """Its predictions depend on the earlier ones: stored ones alone would break the chain."""
    run(tmp_path / "whole", TrueBackbone(remembers=True))
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "broken", TrueBackbone(remembers=True, interrupt_at=3))
    run(tmp_path / "broken", TrueBackbone(remembers=True))
    assert outcome(tmp_path / "broken") == outcome(tmp_path / "whole")


def test_a_run_broken_off_after_its_last_window_predicts_nothing_again(
    tmp_path: Path, no_pictures: None
) -> None:
    run(tmp_path, TrueBackbone(remembers=True))
    before = outcome(tmp_path)
    for name in ("report.json", "map.ply", "trajectory_kitti.txt"):
        (tmp_path / name).unlink()
    again = TrueBackbone(remembers=True)
    run(tmp_path, again)
    assert again.calls == 0
    assert outcome(tmp_path) == before


def test_resuming_with_other_settings_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, TrueBackbone(interrupt_at=1))
    other = load_config(assignments=["windows.size=9", "windows.overlap=3"])
    with pytest.raises(RunFolderError, match=r"windows\.size \(8, now 9\)"):
        run(tmp_path, TrueBackbone(), config=other)


def test_resuming_on_another_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, TrueBackbone(interrupt_at=1))
    with pytest.raises(RunFolderError, match=r"num_frames \(36, now 30\)"):
        run(tmp_path, TrueBackbone(), Corridor(30))


def test_a_stored_window_of_other_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, TrueBackbone(interrupt_at=2))
    windows = tmp_path / "windows"
    (windows / "000000.npz").replace(windows / "000001.npz")
    with pytest.raises(RunFolderError, match="holds other frames than window 1"):
        run(tmp_path, TrueBackbone())


def test_a_finished_run_is_not_run_over(whole: Results) -> None:
    before = outcome(whole.folder)
    with pytest.raises(RunFolderError, match="holds a finished run"):
        run(whole.folder, TrueBackbone())
    assert outcome(whole.folder) == before


def test_a_run_without_a_name_gets_one_and_is_the_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_pictures: None
) -> None:
    monkeypatch.chdir(tmp_path)
    results = Pipeline(Corridor(20), CONFIG, backbone=TrueBackbone()).run()
    assert results.folder.name.startswith("corridor-")
    assert (tmp_path / "runs" / "latest").resolve() == results.folder.resolve()


def test_an_input_without_frames_leaves_no_folder(tmp_path: Path) -> None:
    class Empty(Corridor):
        def frames(self):  # type: ignore[no-untyped-def]
            return iter(())

    with pytest.raises(DatasetError, match="no frames in corridor"):
        run(tmp_path / "run", TrueBackbone(), Empty(5))
    assert not (tmp_path / "run").exists()


def test_progress_counts_up_to_all_frames(tmp_path: Path, no_pictures: None) -> None:
    seen: list[tuple[str, int, int | None]] = []
    Pipeline(
        Corridor(20),
        CONFIG,
        tmp_path / "run",
        backbone=TrueBackbone(),
        on_progress=lambda *step: seen.append(step),
    ).run()
    assert [done for stage, done, _ in seen if stage == "mapping"][-1] == 20
    assert seen[-1][0] == "fusing"
    assert seen[-1][1] == seen[-1][2]


def test_logging_is_left_as_it_was(tmp_path: Path, no_pictures: None) -> None:
    package = logging.getLogger("laser_slam")
    before = (package.level, list(package.handlers))
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, TrueBackbone(interrupt_at=1))
    assert (package.level, package.handlers) == before


def test_scoring_again_gives_the_same_scores(tmp_path: Path, no_pictures: None) -> None:
    results = run(tmp_path / "run", TrueBackbone())
    again = rescore(tmp_path / "run")
    rmse = results.report["trajectory"]["ate_sim3_m"]["rmse"]
    for errors in (again["trajectory"], again["closures"]["trajectory_without"]):
        assert errors["ate_sim3_m"]["rmse"] == pytest.approx(rmse, abs=1e-6)


def test_another_truth_scores_the_path_without_loops_as_well(
    tmp_path: Path, no_pictures: None
) -> None:
    run(tmp_path / "run", TrueBackbone())
    table = np.loadtxt(tmp_path / "run" / "truth_tum.txt")
    table[:, 1:4] *= 3
    np.savetxt(tmp_path / "larger.txt", table)
    report = rescore(tmp_path / "run", tmp_path / "larger.txt")
    for errors in (report["trajectory"], report["closures"]["trajectory_without"]):
        assert errors["path_length_m"] == pytest.approx(3 * 14, rel=0.05)


def test_scoring_against_a_truth_of_another_length_is_refused(
    whole: Results, tmp_path: Path
) -> None:
    lines = (whole.folder / "trajectory_kitti.txt").read_text().splitlines()
    (tmp_path / "short.txt").write_text("\n".join(lines[:-3]))
    with pytest.raises(DatasetError, match="33 poses without time, need 36 lines"):
        rescore(whole.folder, tmp_path / "short.txt")


def test_truth_in_tums_format_finds_its_frames_by_time(whole: Results, tmp_path: Path) -> None:
    lines = (whole.folder / "truth_tum.txt").read_text().splitlines()
    (tmp_path / "some.txt").write_text("\n".join(reversed(lines[5:25])))
    assert rescore(whole.folder, tmp_path / "some.txt")["trajectory"]["num_frames"] == 20


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 lines"),
        ("1 2 3\n", "3 numbers"),
        ("a b c\n", "is no table of poses"),
        ("0 1 2 3 0 0 0 0\n", "a quaternion of zeros"),
        ("nan 1 2 3 0 0 0 1\n", "finite"),
    ],
)
def test_a_truth_that_is_none_is_named(
    whole: Results, tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "truth.txt").write_text(text)
    with pytest.raises(DatasetError, match=message):
        rescore(whole.folder, tmp_path / "truth.txt")


class Watcher(NullViewer):
    """Remember what a run shows."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def window(self, submap: Submap, layers: Layers | None, times_s: np.ndarray) -> None:
        assert times_s.tolist() == pytest.approx([frame / 10 for frame in submap.prediction.frames])
        self.seen.append(f"window {submap.index}")

    def loops(self, places: Sequence[Sim3], records: Sequence[CandidateRecord]) -> None:
        self.seen.append(f"{len(places)} places")

    def results(self, cloud: Cloud, path: Trajectory, path_without_loops: Trajectory) -> None:
        assert len(cloud.points)
        self.seen.append(f"{len(path.frames)} poses")

    def close(self) -> None:
        self.seen.append("closed")


def test_a_viewer_sees_each_window_the_loops_and_the_end(tmp_path: Path, no_pictures: None) -> None:
    viewer = Watcher()
    Pipeline(
        Corridor(16), CONFIG, tmp_path / "run", backbone=TrueBackbone(),
        make_viewer=lambda _folder, _config: viewer,
    ).run()  # fmt: skip
    steps = ["window 0", "1 places", "window 1", "2 places", "window 2", "3 places"]
    assert viewer.seen == [*steps, "3 places", "16 poses", "closed"]


def test_a_viewer_is_closed_when_a_run_breaks_off(tmp_path: Path) -> None:
    viewer = Watcher()
    with pytest.raises(KeyboardInterrupt):
        Pipeline(
            Corridor(24), CONFIG, tmp_path / "run", backbone=TrueBackbone(interrupt_at=2),
            make_viewer=lambda _folder, _config: viewer,
        ).run()  # fmt: skip
    assert viewer.seen[-1] == "closed"


def test_a_resumed_run_draws_the_same_unfiltered_cloud_and_keeps_its_tiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Findings] = []
    monkeypatch.setattr(
        laser_slam.pipeline, "draw_findings", lambda _, found, *__: drawn.append(found)
    )
    monkeypatch.setattr(laser_slam.pipeline, "stages_picture", lambda *_: None)
    stamps = []
    for _ in range(2):
        run(tmp_path / "run", TrueBackbone())
        (tmp_path / "run" / "report.json").unlink()
        tiles = sorted((tmp_path / "run" / "tiles").glob("*.npz"))
        stamps.append([path.stat().st_mtime_ns for path in tiles])
    first, again = (found.raw for found in drawn)
    assert first is not None
    assert again is not None
    assert len(first.points) > 100_000
    assert np.array_equal(first.points, again.points)
    assert stamps[0] == stamps[1]


def test_a_page_that_cannot_be_written_can_be_made_later(
    tmp_path: Path, no_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_folder: Path) -> None:
        raise RunFolderError("no space left on the disk")

    with monkeypatch.context() as patch:
        patch.setattr(laser_slam.pipeline, "write_report_page", fail)
        with pytest.raises(RunFolderError, match="no space"):
            run(tmp_path / "run", TrueBackbone())
    assert not (tmp_path / "run" / "report.html").exists()
    rescore(tmp_path / "run")
    assert (tmp_path / "run" / "report.html").exists()
