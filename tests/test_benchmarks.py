"""Tables of benchmarks: run once, gone on with, and honest about what has no number."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quick_runs import leave_pictures_out
from typer.testing import CliRunner, Result

from laser_slam.backbones.simulated import SimulatedBackbone
from laser_slam.benchmarks import (
    Bench,
    Material,
    Outcome,
    Report,
    Setting,
    as_csv,
    as_markdown,
    fill_grids,
    load_table,
    parse_settings,
    save_table,
    table_names,
)
from laser_slam.benchmarks.measures import MEASURES, look_up
from laser_slam.benchmarks.notes import write_notes
from laser_slam.benchmarks.stretch import Stretch
from laser_slam.benchmarks.table import parse_table
from laser_slam.cli import app
from laser_slam.cli.bench_command import BenchFlags
from laser_slam.config import SyntheticConfig, load_config
from laser_slam.datasets import DATASETS
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.save import save_kitti_layout
from laser_slam.errors import ConfigError, DatasetError
from laser_slam.types import Prediction

NUM_FRAMES = 14
SIMULATED = [
    "backbone.name=simulated", "backbone.simulated.width=126", "windows.size=8",
    "windows.overlap=3", "windows.min_parallax_px=0", "run.samples=2", "fusion.stride=4",
]  # fmt: skip


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_pictures_out(monkeypatch)
    monkeypatch.delenv("LASER_SLAM_DATA", raising=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder that holds KITTI 03, in miniature, and none of the others."""
    root = tmp_path_factory.mktemp("data")
    config = SyntheticConfig(num_frames=NUM_FRAMES, width=126, height=56)
    save_kitti_layout(SyntheticDrive(config), root / "kitti_odometry", "03")
    return root


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """A table of two rows, run by the command line."""
    out = tmp_path_factory.mktemp("bench") / "out"
    with pytest.MonkeyPatch.context() as patch:
        leave_pictures_out(patch)
        return out, bench(data, out)


def bench(data: Path, out: Path, *more: str) -> Result:
    arguments = ["bench", "kitti", "--only", "03,04", "--data", str(data), "--out", str(out)]
    arguments += ["--quiet", "--page", str(out / "page.md"), "--setting", "ours="]
    arguments += ["--setting", "no loops=closures.enabled=false,layers.enabled=never"]
    more = tuple(part for name in SIMULATED for part in ("--set", name)) + more
    return CliRunner().invoke(app, [*arguments, *more], env={"COLUMNS": "300"})


def test_sequences_may_lie_in_the_data_folder_itself(data: Path) -> None:
    spec = load_table("kitti").sequences["03"]
    found = Material(data / "kitti_odometry").open(spec, load_config())
    assert found.info.num_frames == NUM_FRAMES


def test_a_table_runs_and_stands_beside_what_others_published(
    finished: tuple[Path, Result],
) -> None:
    out, result = finished
    assert result.exit_code == 0, result.output
    for words in ("ATE RMSE, m", "ours (simulated)", "no loops", "LASER (pi3) [1]", "2.64"):
        assert words in result.stdout, words
    assert {path.name for path in out.iterdir()} == {
        "kitti.md", "kitti.csv", "page.md", "ours", "no-loops"
    }  # fmt: skip


def test_the_numbers_are_those_of_the_reports(finished: tuple[Path, Result]) -> None:
    out, _ = finished
    lines = list(csv.DictReader(io.StringIO((out / "kitti.csv").read_text())))
    for method, folder in (("ours", "ours"), ("no loops", "no-loops")):
        report = json.loads((out / folder / "03" / "report.json").read_text())
        found = {
            (line["column"], line["num"], line["num_wanted"]): float(line["value"])
            for line in lines
            if line["method"] == method and line["measure"] == "ate_m" and line["value"]
        }
        ate = report["trajectory"]["ate_sim3_m"]["rmse"]
        assert found == {("03", "1", "1"): pytest.approx(ate)}
        assert ate > 0


def test_what_has_no_data_is_a_row_that_says_so(finished: tuple[Path, Result]) -> None:
    text = (finished[0] / "kitti.md").read_text()
    assert "\n- 04: no KITTI sequence in DATA/kitti_odometry/sequences (there: 03)\n" in text
    both = "Translation error t_rel, percent and Rotation error r_rel, degrees per 100 m"
    assert f"\n- 03: {both}: too little of it for this score\n" in text
    assert "\n- 00, 01, 02, 05, 06, 07, 08, 09, 10: not asked for\n" in text


def test_a_part_of_a_sequence_is_marked(finished: tuple[Path, Result]) -> None:
    out, result = finished
    text = (out / "kitti.md").read_text()
    assert "- 03: \\*: only a part is there: 14 of 801 frames" in text
    line = next(line for line in text.splitlines() if line.startswith("| **ours (simulated)** |"))
    cells = [part.strip() for part in line.split("|")]
    assert cells[2:4] == ["-", "-"]  # no mean has it in it
    assert cells[4].endswith("\\*")
    assert f"{cells[4][:-2]}*" in result.stdout


def test_finished_runs_are_not_run_again(data: Path, finished: tuple[Path, Result]) -> None:
    out, first = finished
    reports = {path: path.stat().st_mtime_ns for path in out.rglob("report.json")}
    assert len(reports) == 2
    again = bench(data, out)
    assert again.stdout == first.stdout
    assert {path: path.stat().st_mtime_ns for path in out.rglob("report.json")} == reports


def test_a_finished_run_of_other_settings_is_no_number(
    data: Path, finished: tuple[Path, Result]
) -> None:
    out, _ = finished
    assert bench(data, out, "--set", "windows.size=9").exit_code == 1
    text = (out / "kitti.md").read_text()
    assert "RUNS/ours/03 holds a run with other settings: windows.size (8, now 9)" in text
    assert str(out) not in text
    bench(data, out)  # leaves the files as they were


def test_the_page_holds_each_table_once_with_its_command(finished: tuple[Path, Result]) -> None:
    text = (finished[0] / "page.md").read_text()
    assert text.count("## KITTI odometry") == 1
    assert "laser-slam bench kitti --only 03,04 --setting ours=" in text
    assert "--data DATA" in text
    assert str(finished[0]) not in text
    report = Report("other", load_table("kitti"), [], [], "laser-slam bench other")
    page = finished[0] / "page.md"
    save_table(finished[0] / "other", report, page)
    save_table(finished[0] / "other", report, page)
    both = page.read_text()
    assert both.startswith(text.rstrip())
    assert both.count("laser-slam bench other") == 1
    page.write_text(text)


def test_every_shipped_table_can_be_run_as_it_stands() -> None:
    """Its rows are settings that exist, its readers are there, and its values fit its columns."""
    assert {"here", "kitti", "depth", "pose", "points", "waymo", "ablation"} <= set(table_names())
    for name in table_names():
        table = load_table(name)
        for setting in parse_settings([], table):
            load_config(assignments=[*table.settings, *setting.assignments])
        for sequence in table.sequences.values():
            load_config(assignments=sequence.settings)
            assert sequence.reader in {*DATASETS, "path"}
        for block in table.blocks:
            assert all(row.source for row in block.published)


def test_the_command_names_every_table() -> None:
    told = CliRunner().invoke(app, ["bench", "--help"], env={"COLUMNS": "200"}).output
    assert all(name in told for name in table_names())


@pytest.mark.parametrize("block", [0, 1, 2])
def test_published_means_over_waymo_are_those_of_their_segments(block: int) -> None:
    for row in load_table("waymo").blocks[block].published:
        mean, *values = (float(value) for value in row.values if value is not None)
        assert len(values) == 9
        assert sum(values) / 9 == pytest.approx(mean, abs=0.0011), row.method


def outcome(name: str, ate: float | None, reason: str | None = None) -> Outcome:
    scores = {"run": {"trajectory": {"ate_sim3_m": {"rmse": ate}}}}
    return Outcome("ours", name, {} if reason else scores, reason)


def test_a_mean_is_over_what_has_a_number_and_says_over_how_many() -> None:
    table = load_table("kitti")
    outcomes = [outcome("00", 2.0), outcome("01", 100.0), outcome("02", None, "lost its way")]
    row = fill_grids(table, outcomes)[0].rows[0]
    assert [cell.text for cell in row.cells[:5]] == [
        "51.000 (2 of 11)", "2.000 (1 of 10)", "2.000", "100.000", "-"
    ]  # fmt: skip
    assert row.cells[0].reasons["02"] == "lost its way"
    assert row.cells[0].reasons["05"] == "not asked for"


def test_blocks_that_nothing_was_asked_of_are_left_out() -> None:
    table = load_table("here")
    titles = [block.title for block in table.blocks]
    only_raw = fill_grids(table, [outcome("kitti-raw", 1.0)])
    assert [grid.title for grid in only_raw] == [title for title in titles if "Depth" in title]


def test_a_sequence_may_have_a_line_of_its_own_for_each_row() -> None:
    table = load_table("here")
    outcomes = [outcome("drive", 1.0), Outcome("other", "drive", reason="broken")]
    paths = fill_grids(table, outcomes)[0]
    assert [row.name for row in paths.rows] == ["drive, ours", "drive, other"]
    assert [row.cells[2].text for row in paths.rows] == ["1.000", "-"]
    assert "drive (other): broken" in write_notes(table, [paths], outcomes)
    assert [row.name for row in fill_grids(table, outcomes[:1])[0].rows] == ["drive"]


def test_markdown_and_csv_say_what_is_missing_and_escape_it() -> None:
    table = load_table("kitti")
    outcomes = [outcome("00", 2.0), outcome("01", None, "a | b,\nc")]
    grids = fill_grids(table, outcomes)
    assert "\n- 01: a \\| b, c\n" in as_markdown(table, grids, outcomes)
    lines = list(csv.DictReader(io.StringIO(as_csv("kitti", grids))))
    (line,) = (one for one in lines if one["column"] == "01" and one["measure"] == "ate_m"
               and one["method"] == "ours")  # fmt: skip
    assert (line["value"], line["num"], line["notes"]) == ("", "0", "01: a | b,\nc")
    assert "01: a | b,\nc" in write_notes(table, grids, outcomes)


def test_without_data_the_reason_says_how_to_pass_it(tmp_path: Path) -> None:
    work = Bench(load_table("kitti"), Material(None), tmp_path, only=("03",))
    (found,) = work.run([Setting("ours")])
    assert found.reason is not None
    assert "pass --data, or set LASER_SLAM_DATA" in found.reason
    work = Bench(load_table("kitti"), Material(tmp_path / "nowhere"), tmp_path, only=("03",))
    assert "not there, neither in kitti_odometry nor elsewhere in the data folder" in str(
        work.run([Setting("ours")])[0].reason
    )


def test_what_lies_nowhere_is_one_line_for_all_of_it(tmp_path: Path) -> None:
    table = load_table("depth")
    work = Bench(table, Material(tmp_path), tmp_path / "out", only=("bonn",))
    outcomes = work.run(parse_settings([], table))
    (line,) = write_notes(table, [], outcomes)
    assert line == "bonn (5): not there, neither in bonn nor elsewhere in the data folder"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("=windows.size=3", "--setting wants NAME=section.key=value"),
        ("nothing", "or a row of the table (ours, vggt-long), got 'nothing'"),
    ],
)
def test_a_wrong_setting_is_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_settings([text], load_table("kitti"))
    assert words in str(error.value)


def test_rows_that_would_share_a_folder_are_refused() -> None:
    with pytest.raises(ConfigError, match="given twice"):
        parse_settings(["w/o LSA=", "w o LSA="], load_table("kitti"))
    table = parse_table("{title: t, rows: {a b: [], a-b: []}, sequences: {}, blocks: []}")
    with pytest.raises(ConfigError, match="'a b' is given twice, or shares the folder a-b"):
        parse_settings([], table)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["kiti"], "no table 'kiti' (did you mean kitti?); there is "),
        (["kitti", "--only", "99"], "--only 99: no such sequence; there is all"),
        (["kitti", "--setting", "a=windows.sise=3"], "windows.sise: no such setting"),
    ],
)
def test_a_wrong_command_is_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["bench", *arguments, "--out", str(out), "--quiet"])
    assert result.exit_code == 1
    assert words in result.stderr
    assert not out.exists()


def test_the_users_settings_lie_over_the_tables_and_under_the_rows() -> None:
    flags = BenchFlags(set=["windows.size=11", "windows.overlap=4"], backbone="simulated")
    config = flags.resolve(["windows.size=9", "run.samples=3"], ["windows.overlap=5"])
    assert (config.windows.size, config.windows.overlap, config.run.samples) == (11, 5, 3)
    assert config.backbone.name == "simulated"


def test_a_stretch_is_a_data_set_of_its_own(data: Path) -> None:
    whole = KittiOdometry(data / "kitti_odometry", "03")
    part = Stretch(whole, 2, 11, 3)
    frames = list(part.frames())
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.time_s for frame in frames] == pytest.approx([0.2, 0.5, 0.8])
    assert part.info.num_frames == 3
    assert [path.stem for path in part.info.files] == ["000002", "000005", "000008"]
    truth, of_whole = part.info.truth, whole.info.truth
    assert truth is not None
    assert of_whole is not None
    assert truth.frames.tolist() == [0, 1, 2]
    assert (truth.world_from_cam[1] == of_whole.world_from_cam[5]).all()
    depth, same = part.true_depth(2), whole.true_depth(8)
    assert depth is not None
    assert same is not None
    np.testing.assert_array_equal(depth, same)
    with pytest.raises(DatasetError, match="14 frames, none from 20 on"):
        Stretch(whole, 20, None, 1)


SCORED = """
    title: all that is scored after a run
    settings: [backbone.simulated.scale_sigma=0.3, registration.min_pixels=50]
    sequences: {"03": {reader: kitti, at: ["kitti_*"], arguments: {sequence: "03"}}}
    blocks:
      - title: t
        columns:
          - {name: AbsRel, measure: bonn_abs_rel, over: "03"}
          - {name: delta, measure: bonn_delta_percent, over: "03"}
          - {name: Acc, measure: indoor_acc_median_m, over: "03"}
          - {name: NC, measure: indoor_nc, over: "03"}
          - {name: Chamfer, measure: outdoor_chamfer_m, over: "03"}
"""
EXACT = tuple(
    f"backbone.simulated.{name}=0"
    for name in (
        "smooth_sigma layer_sigma noise_smooth noise_iid edge_blur_px blob_share "
        "pose_rotation_deg pose_translation drift_rotation_deg drift_translation"
    ).split()
)


def test_depth_and_points_of_every_frame_are_scored_after_the_run(
    data: Path, tmp_path: Path
) -> None:
    """Windows of exact depth and another unit each: what is left is what was joined wrongly."""
    table = parse_table(SCORED)
    noisy = ("backbone.simulated.noise_iid=0.1", "backbone.simulated.noise_smooth=0.05")
    rows = [
        Setting("exact", (*SIMULATED, *EXACT)),
        Setting("noisy", (*SIMULATED, *EXACT, *noisy)),
    ]
    outcomes = Bench(table, Material(data), tmp_path).run(rows)
    assert [found.reason for found in outcomes] == [None, None]
    video = outcomes[0].scores["video_depth_bonn"]
    assert video["num_frames"] == NUM_FRAMES
    assert video["coverage"] > 0.9
    exact, worse = (
        [cell.value for cell in row.cells] for row in fill_grids(table, outcomes)[0].rows
    )
    abs_rel, delta, accuracy, normals, chamfer = (float(str(value)) for value in exact)
    assert abs_rel < 0.01
    assert delta > 99
    assert accuracy < 0.05
    assert normals > 0.7
    assert chamfer < 1.0
    assert float(str(worse[0])) > 5 * abs_rel
    assert float(str(worse[2])) > accuracy


def test_scores_that_are_kept_are_not_worked_out_again(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Bench(parse_table(SCORED), Material(data), tmp_path)
    rows = [Setting("exact", (*SIMULATED, *EXACT))]
    first = work.run(rows)
    monkeypatch.setattr("laser_slam.benchmarks.row_run.PROTOCOLS", {})
    assert work.run(rows) == first
    (tmp_path / "exact" / "03" / "bench.json").write_text("{")
    assert "it will be worked out anew" in str(work.run(rows)[0].reason)


def test_rows_of_equal_windows_can_share_one_prediction(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    predict = SimulatedBackbone.predict

    def counted(self: SimulatedBackbone, *arguments: Any) -> Prediction:
        asked.append(len(arguments[1]))
        return predict(self, *arguments)

    monkeypatch.setattr(SimulatedBackbone, "predict", counted)
    work = Bench(load_table("kitti"), Material(data), tmp_path, only=("03",), is_shared=True)
    plain = (*SIMULATED, "closures.enabled=false")
    rows = [
        Setting("layers", plain),
        Setting("no layers", (*plain, "layers.enabled=never")),
        Setting("joint", (*plain, "preset=vggt-long")),
    ]
    outcomes = work.run(rows)
    assert [found.reason for found in outcomes] == [None] * 3
    assert len(asked) == 3  # windows of 8 with 3 shared: frames 0-7, 5-12, 10-13
    assert len(list((tmp_path / "predictions").iterdir())) == 1
    ates = [look_up(found.scores, MEASURES["ate_m"]) for found in outcomes]
    assert ates[0] == ates[1] != ates[2]  # layers leave poses alone, another registration does not
    assert work.run(rows) == outcomes
    work.run([Setting("short", (*plain, "windows.size=7"))])
    assert len(list((tmp_path / "predictions").iterdir())) == 2
