"""Hours of runs: what is asked for first, who works where, and what is left when one is killed."""

import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml
from quick_runs import leave_pictures_out
from typer.testing import CliRunner, Result

from laser_slam.backbones import BACKBONES
from laser_slam.benchmarks import Bench, Material, Setting, load_table, parse_settings
from laser_slam.benchmarks.claims import TakenError, claimed
from laser_slam.benchmarks.outcome import NOT_YET
from laser_slam.benchmarks.pace import Pace
from laser_slam.benchmarks.table import SequenceSpec, parse_table
from laser_slam.cli import app
from laser_slam.cli.bench_command import BenchFlags
from laser_slam.config import Config, SyntheticConfig
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.save import save_kitti_layout
from laser_slam.errors import ConfigError, WeightsError
from laser_slam.pipeline import Pipeline

SIMULATED = (
    "backbone.name=simulated", "backbone.simulated.width=126", "windows.size=8",
    "windows.overlap=3", "windows.min_parallax_px=0", "run.samples=2", "fusion.stride=4",
    "closures.enabled=false",
)  # fmt: skip
PLAIN, NO_LAYERS = (
    Setting("plain", SIMULATED),
    Setting("no layers", (*SIMULATED, "layers.enabled=never")),
)
NETWORK = Setting("network", (*SIMULATED, "backbone.name=pi3"))


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_pictures_out(monkeypatch, page=True)
    monkeypatch.delenv("LASER_SLAM_DATA", raising=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KITTI 03 and 04 in miniature."""
    root = tmp_path_factory.mktemp("data")
    for name, num in (("03", 14), ("04", 9)):
        config = SyntheticConfig(num_frames=num, width=126, height=56)
        save_kitti_layout(SyntheticDrive(config), root / "kitti_odometry", name)
    return root


def work(data: Path, out: Path, **more: Any) -> Bench:
    return Bench(load_table("kitti"), Material(data), out, only=("03", "04"), **more)


def test_what_cannot_be_had_is_found_out_before_the_first_run_and_once(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Weights that are missing are no reason against other rows, nor looked for in each."""
    happened: list[str] = []

    def no_weights(*_: object) -> None:
        happened.append("weights")
        raise WeightsError("backbone.pi3.weights: not set")

    def noted(*arguments: Any, **more: Any) -> Pipeline:
        happened.append("run")
        return Pipeline(*arguments, **more)

    monkeypatch.setattr("laser_slam.benchmarks.readiness.make_backbone", no_weights)
    monkeypatch.setattr("laser_slam.benchmarks.row_run.Pipeline", noted)
    other = Setting("network, no layers", (*NETWORK.assignments, "layers.enabled=never"))
    with caplog.at_level(logging.WARNING):
        found = work(data, tmp_path).run([PLAIN, NETWORK, other])
    assert happened == ["weights", "run", "run"]
    assert [bool(one.scores) for one in found] == [True, True, False, False, False, False]
    assert {one.reason for one in found[2:]} == {"backbone.pi3.weights: not set"}
    assert [one.backbone for one in found] == ["simulated"] * 2 + ["pi3"] * 4
    assert caplog.text.count("backbone.pi3.weights: not set") == 1


def test_a_network_is_made_once_for_all_runs(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[object] = []
    used: list[object] = []

    def make(*_: object) -> object:
        made.append(object())
        return made[-1]

    def broken(*_: object, backbone: object, **__: object) -> None:
        used.append(backbone)
        raise RuntimeError("CUDA out of memory")

    monkeypatch.setattr("laser_slam.benchmarks.readiness.make_backbone", make)
    monkeypatch.setattr("laser_slam.benchmarks.row_run.Pipeline", broken)
    found = work(data, tmp_path).run([NETWORK, Setting("other", NETWORK.assignments)])
    assert len(made) == 1
    assert used == made * 4
    assert {one.reason for one in found} == {"RuntimeError: CUDA out of memory"}


def test_a_backbone_of_ones_own_needs_no_settings(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BACKBONES, "mine", f"{__name__}:Mine")
    found = work(data, tmp_path).run([PLAIN, Setting("mine", (*SIMULATED, "backbone.name=mine"))])
    assert [one.reason for one in found] == [None, None, "mine: no weights", "mine: no weights"]


class Mine:
    def __init__(self, config: object) -> None:
        raise WeightsError("mine: no weights")


def test_a_bug_in_one_run_is_its_reason_with_a_traceback_and_the_others_go_on(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(dataset: Any, *arguments: Any, **more: Any) -> Pipeline:
        if dataset.info.num_frames == 14:
            raise TypeError("no such thing")
        return Pipeline(dataset, *arguments, **more)

    monkeypatch.setattr("laser_slam.benchmarks.row_run.Pipeline", broken)
    found = work(data, tmp_path).run([PLAIN])
    assert [one.reason for one in found] == ["TypeError: no such thing", None]
    assert "Traceback" in caplog.text


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("backbone.name=pi4", "backbone.name: no 'pi4'; there is classical"),
        ("layers.segmentation.segmenter=sam9", "layers.segmentation.segmenter: no 'sam9'"),
        ("places.descriptor=gist", "places.descriptor: no 'gist'"),
        ("preset=papr", "preset: no 'papr'"),
        ("windows.overlap=8", "overlap (8) must be smaller than size (8)"),
    ],
)
def test_a_wrong_setting_of_the_last_row_is_told_before_the_first_runs(
    assignment: str, words: str, data: Path, tmp_path: Path
) -> None:
    wrong = Setting("wrong", (*SIMULATED, assignment))
    with pytest.raises(ConfigError) as error:
        work(data, tmp_path / "out").run([PLAIN, wrong])
    assert words in str(error.value)
    assert not (tmp_path / "out").exists()


def test_after_each_run_all_outcomes_are_handed_on(data: Path, tmp_path: Path) -> None:
    """All rows on one sequence, then the next: a table that is half done compares already."""
    seen: list[list[str]] = []
    work(data, tmp_path).run(
        [PLAIN, NO_LAYERS],
        on_outcomes=lambda found: seen.append([one.reason or one.sequence for one in found]),
    )
    assert seen == [
        ["03", NOT_YET, NOT_YET, NOT_YET],
        ["03", NOT_YET, "03", NOT_YET],
        ["03", "04", "03", NOT_YET],
        ["03", "04", "03", "04"],
    ]


def test_a_table_that_grows_never_shows_less_than_before(data: Path, tmp_path: Path) -> None:
    work(data, tmp_path).run([PLAIN])
    seen: list[list[str | None]] = []
    work(data, tmp_path).run(
        [NO_LAYERS, PLAIN], on_outcomes=lambda found: seen.append([one.reason for one in found])
    )
    assert seen == [[None, NOT_YET, None, None], [None] * 4]


def test_an_input_is_opened_once_for_all_rows_of_it(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And once before, to see that it is there."""
    opened: list[object] = []
    open_it = Material.open

    def counted(self: Material, spec: SequenceSpec, config: Config) -> Dataset:
        opened.append(spec.arguments["sequence"])
        return open_it(self, spec, config)

    monkeypatch.setattr(Material, "open", counted)
    found = work(data, tmp_path).run([PLAIN, NO_LAYERS])
    assert all(one.scores for one in found)
    assert opened == ["03", "04", "03", "04"]


def test_a_wrong_name_of_a_sequence_gets_a_hint() -> None:
    bench = Bench(load_table("pose"), Material(None), Path("out"), only=("sintel-aley_2",))
    with pytest.raises(ConfigError) as error:
        bench.sequences()
    assert "no such sequence (did you mean sintel-alley_2?); there is sintel, " in str(error.value)
    assert "--list shows all" in str(error.value)
    assert len(str(error.value)) < 400


def test_two_processes_share_the_work(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that another is at is left to it, looked at again at the end, and never disturbed."""
    folder = tmp_path / "plain" / "03"
    with claimed(folder):
        found = work(data, tmp_path).run([PLAIN])
        assert list(folder.iterdir()) == []
    assert [bool(one.scores) for one in found] == [False, True]
    reason = "another process is at work in RUNS/plain/03: run this again when it has ended"
    assert found[0].reason == reason
    assert all(one.scores for one in work(data, tmp_path).run([PLAIN]))


def test_what_is_done_is_read_by_several_at_once(data: Path, tmp_path: Path) -> None:
    """So that processes that start together do not miss the numbers that are there."""
    first = work(data, tmp_path).run([PLAIN])
    with claimed(tmp_path / "plain" / "03", to_read=True):
        assert work(data, tmp_path).run([PLAIN]) == first
        lean = work(data, tmp_path, is_lean=True)
        assert "another process" in str(lean.run([PLAIN])[0].reason)  # for windows are to go
    assert lean.run([PLAIN]) == first
    with claimed(tmp_path / "plain" / "03", to_read=True):
        assert lean.run([PLAIN]) == first


def test_what_another_process_finishes_meanwhile_is_taken(data: Path, tmp_path: Path) -> None:
    done = threading.Event()
    started = threading.Event()

    def other() -> None:
        with claimed(tmp_path / "plain" / "03"):
            started.set()
            done.wait(60)

    thread = threading.Thread(target=other)
    thread.start()
    assert started.wait(10)

    def let_go(_: object) -> None:
        done.set()
        thread.join()

    found = work(data, tmp_path).run([PLAIN], on_outcomes=let_go)
    assert all(one.scores for one in found)


def test_a_claim_is_for_one_and_leaves_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "run"
    with claimed(folder):
        with pytest.raises(TakenError, match="another process is at work"), claimed(folder):
            pass
        assert folder.is_dir()
    assert not folder.exists()
    with claimed(folder, to_read=True), claimed(folder, to_read=True):
        with pytest.raises(TakenError), claimed(folder):
            pass
        assert folder.is_dir()
    with claimed(folder):
        (folder / "kept").touch()
    assert (folder / "kept").exists()


def test_where_folders_cannot_be_locked_claims_are_taken_for_granted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, which cannot open a folder either."""

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("laser_slam.benchmarks.claims.fcntl", None)
    monkeypatch.setattr("laser_slam.benchmarks.claims.os.open", refuse)
    with claimed(tmp_path / "run"), claimed(tmp_path / "run"):
        assert (tmp_path / "run").is_dir()
    assert not (tmp_path / "run").exists()


def test_a_folder_that_its_last_user_removes_meanwhile_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before it is opened, and between that and the lock."""
    folder, open_it, lock = tmp_path / "run", os.open, fcntl.flock

    def open_removed(path: Path, flags: int) -> int:
        folder.rmdir()
        return open_it(path, flags)

    def lock_removed(handle: int, how: int) -> None:
        folder.rmdir()
        lock(handle, how)

    for place, late in (("os.open", open_removed), ("fcntl.flock", lock_removed)):
        with monkeypatch.context() as patch:
            patch.setattr(f"laser_slam.benchmarks.claims.{place}", late)
            with pytest.raises(TakenError, match="was at work"), claimed(folder):
                pass
        assert not folder.exists()


def test_of_paths_in_reasons_the_whole_is_hidden_and_words_stay(tmp_path: Path) -> None:
    bench = Bench(load_table("kitti"), Material(Path("data")), Path("r"), only=("03",))
    (run,) = bench.runs([PLAIN])
    found = run.without("r/ours/03 is no run: data/kitti and my-data/r.txt for data-sets")
    assert found.reason == "RUNS/ours/03 is no run: DATA/kitti and my-data/r.txt for data-sets"
    bench = Bench(load_table("kitti"), Material(None), tmp_path, only=("03",))
    (run,) = bench.runs([PLAIN])
    assert run.without(f"cannot use {tmp_path}: full").reason == "cannot use RUNS: full"


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = CliRunner().invoke(app, ["bench", "kitti", "--only", "05", "--quiet",
                                      "--out", str(tmp_path / "file/out")])  # fmt: skip
    assert result.exit_code == 1
    assert "cannot use" in result.stderr
    assert "choose another with --out" in result.stderr


def test_a_lean_table_keeps_scores_and_no_windows(data: Path, tmp_path: Path) -> None:
    rows = [PLAIN, NO_LAYERS]
    whole = work(data, tmp_path / "whole", is_shared=True).run(rows)
    lean = work(data, tmp_path / "lean", is_shared=True, is_lean=True)
    first = lean.run(rows)
    wall = ("frames_per_second",)
    for one, other in zip(first, whole, strict=True):
        numbers = [
            {k: v for k, v in o.scores["run"].items() if k not in wall} for o in (one, other)
        ]
        assert numbers[0] == numbers[1]
    left = {path.name for path in (tmp_path / "lean" / "plain" / "03").iterdir()}
    assert {"report.json", "trajectory_tum.txt", "config.yaml"} <= left
    assert not {"windows", "layers", "tiles", "map.ply"} & left
    assert list((tmp_path / "lean" / "predictions").iterdir()) == []
    assert (tmp_path / "whole" / "plain" / "03" / "windows").is_dir()
    assert lean.run(rows) == first  # known, though what they were made of is gone


def test_a_lean_run_cannot_be_scored_otherwise_later(data: Path, tmp_path: Path) -> None:
    table = parse_table("""
        title: more
        sequences: {"03": {reader: kitti, at: [kitti_odometry], arguments: {sequence: "03"}}}
        blocks: [{title: t, columns: [{name: c, measure: bonn_abs_rel, over: "03"}]}]
        """)
    work(data, tmp_path, is_lean=True).run([PLAIN])
    (found,) = Bench(table, Material(data), tmp_path).run([PLAIN])
    assert found.reason is not None
    assert "RUNS/plain/03 has no windows any more (--lean) to work out video_depth_" in found.reason


def test_shared_runs_are_known_by_another_path(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = work(data, tmp_path / "a", is_shared=True).run([PLAIN])
    (tmp_path / "a").rename(tmp_path / "b")
    monkeypatch.chdir(tmp_path)
    assert work(data, Path("b"), is_shared=True).run([PLAIN]) == first
    (found, _) = work(data, Path("b")).run([PLAIN])
    assert found.reason is not None
    assert "RUNS/plain/03 holds a run that was made with --share; remove it" in found.reason


def test_scores_of_another_version_are_worked_out_anew(data: Path, tmp_path: Path) -> None:
    table = parse_table("""
        title: depth
        sequences: {"03": {reader: kitti, at: [kitti_odometry], arguments: {sequence: "03"}}}
        blocks: [{title: t, columns: [{name: c, measure: bonn_abs_rel, over: "03"}]}]
        """)
    bench = Bench(table, Material(data), tmp_path)
    first = bench.run([PLAIN])
    kept = tmp_path / "plain" / "03" / "bench.json"
    content = json.loads(kept.read_text())
    other = {**content, "version": content["version"] - 1}
    for old in map(json.dumps, (other, content["scores"], 0)):
        kept.write_text(old)
        assert bench.run([PLAIN]) == first
        assert json.loads(kept.read_text()) == content


def test_prepared_frames_are_not_chosen_again_and_what_cannot_be_read_is_passed_over(
    data: Path, tmp_path: Path
) -> None:
    spec = load_table("kitti").sequences["03"]
    chosen = spec.model_copy(update={"frames": (0, None, 2)})
    prepared = chosen.model_copy(update={"at": ("nowhere",), "prepared": ("kitti_odometry",)})
    config = work(data, tmp_path).runs([PLAIN])[0].config
    assert Material(data).open(chosen, config).info.num_frames == 7
    assert Material(data).open(prepared, config).info.num_frames == 14
    (tmp_path / "kitti_odometry").mkdir()
    (tmp_path / "dataset").symlink_to(data / "kitti_odometry")
    assert Material(tmp_path).open(spec, config).info.num_frames == 14


def test_the_rest_of_the_time_follows_from_the_frames() -> None:
    pace = Pace({"a": 100, "b": 0, "c": 300})  # b: as long as the others are
    assert pace.left() == "3 runs to go"
    pace.note("a", 60.0)
    assert pace.left() == "2 runs to go, about 5 min"
    pace.drop("b")
    assert pace.left() == "1 run to go, about 3 min"
    pace.note("c", 180.0)
    assert pace.left() == "0 runs to go"


def command(data: Path, out: Path, *more: str) -> list[str]:
    settings = [part for name in SIMULATED for part in ("--set", name)]
    rows = ["--setting", "ours=", "--setting", "no layers=layers.enabled=never"]
    arguments = ["kitti", "--only", "03,04", "--data", str(data), "--out", str(out), "--quiet"]
    return ["bench", *arguments, *rows, *settings, *more]


def run_command(data: Path, out: Path, *more: str) -> Result:
    return CliRunner().invoke(app, command(data, out, *more))


KILLED = """
import os, signal, sys
import laser_slam.store.files as files
for name in ("draw_findings", "stages_picture", "write_report_page"):
    import laser_slam.pipeline
    setattr(laser_slam.pipeline, name, lambda *_: None)
at, flush = int(sys.argv.pop(1)), files.flush
def flush_or_die(path):
    global at
    at -= 1
    if at == 0:
        os.kill(os.getpid(), signal.SIGKILL)  # with a file half written beside it
    flush(path)
files.flush = flush_or_die
from laser_slam.cli import main
main()
"""


def test_a_killed_table_ends_as_one_that_was_not(data: Path, tmp_path: Path) -> None:
    """Killed while the first windows are stored, and again in a later run."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert run_command(data, whole).exit_code == 0
    for at in (6, 40):
        killed = subprocess.run(
            [sys.executable, "-c", KILLED, str(at), *command(data, broken)],
            check=False,
            capture_output=True,
        )
        assert killed.returncode == -signal.SIGKILL, killed.stderr
    num = len(list(broken.glob("*/*/report.json")))
    assert 0 < num < 4
    assert run_command(data, broken).exit_code == 0
    for name in ("kitti.md", "kitti.csv"):
        assert (broken / name).read_bytes() == (whole / name).read_bytes()


def test_an_interrupted_table_says_how_to_go_on(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(dataset: Any, *arguments: Any, **more: Any) -> Pipeline:
        if dataset.info.num_frames == 9:
            raise KeyboardInterrupt
        return Pipeline(dataset, *arguments, **more)

    monkeypatch.setattr("laser_slam.benchmarks.row_run.Pipeline", interrupted)
    result = run_command(data, tmp_path)
    assert result.exit_code == 130
    assert f"interrupted; 2 of 4 runs are finished in {tmp_path}; the same command" in result.stderr
    assert "- 04: not run yet" in (tmp_path / "kitti.md").read_text()


def test_a_table_without_a_number_is_no_success(data: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["bench", "kitti", "--only", "05", "--data", str(data),
                                      "--out", str(tmp_path), "--quiet"])  # fmt: skip
    assert result.exit_code == 1
    assert "05: no KITTI sequence in DATA/kitti_odometry/sequences (there: 03, 04)" in result.stdout
    assert "no row has a number; the notes say why" in result.stderr
    assert (tmp_path / "kitti.csv").exists()


def test_tables_and_what_they_would_run_can_be_listed(data: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["bench"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    assert "Ablations (20 rows, 32 sequences)" in result.stdout
    run_command(data, tmp_path, "--only", "03")
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(app, [*command(data, tmp_path), "--list", "--only", "all"],
                                env={"COLUMNS": "200"})  # fmt: skip
    assert result.exit_code == 0
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert "no layers layers.enabled=never" in lines
    assert "03 finished" in lines
    assert "04 9 of 271 frames" in lines
    there = f"{data}/kitti_odometry/sequences (there: 03, 04)"
    others = "00, 01, 02, 05, 06, 07, 08, 09, 10"
    assert f"{others} no: no KITTI sequence in {there}" in " ".join(lines)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_table_of_ones_own_runs_by_its_path(data: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("""
title: mine
rows: {ours: [], vggt-long: [preset=vggt-long, registration.huber_delta=0.2]}
sequences: {"04": {reader: kitti, at: [kitti_odometry], arguments: {sequence: "04"}}}
blocks: [{title: errors, columns: [{name: ATE, measure: ate_m, over: "04"}]}]
""")
    settings = [part for name in SIMULATED for part in ("--set", name)]
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["bench", str(mine), "--data", str(data), "--out", str(out),
                                      "--quiet", *settings])  # fmt: skip
    assert result.exit_code == 0, result.output
    text = (out / "mine.md").read_text()
    assert "laser-slam bench mine.yaml --set" in text
    assert str(tmp_path) not in text
    # The run says which preset it was, and that a setting of the row's lies over it.
    config = yaml.safe_load((out / "vggt-long" / "04" / "config.yaml").read_text())
    assert config["preset"] == "vggt-long"
    assert config["registration"]["rigid"] == "joint"
    assert config["registration"]["huber_delta"] == 0.2
    assert config["pose_graph"]["robust"] is False


def test_the_command_of_a_table_names_all_that_its_numbers_depend_on() -> None:
    flags = BenchFlags(data=Path("/x"), only="03", config="/y/mine.yaml", share=True, lean=True)
    told = "laser-slam bench kitti --only 03 --config mine.yaml --share --lean --data DATA"
    assert flags.command("kitti") == told


def test_the_row_of_sam_2_says_what_it_lacks(tmp_path: Path) -> None:
    """Before anything is predicted."""
    table = load_table("ablation")
    bench = Bench(table, Material(None), tmp_path, only=("simulated",))
    (found,) = bench.run(parse_settings(["w/ SAM 2"], table))
    assert found.reason is not None
    assert "sam2" in found.reason
    assert list(tmp_path.iterdir()) == []
