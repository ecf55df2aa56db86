"""Tables as people read them: published numbers as printed, at any width, the best one marked."""

import csv
import io
import re
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from laser_slam.benchmarks import (
    Grid,
    Outcome,
    Setting,
    as_csv,
    as_markdown,
    fill_grids,
    load_table,
    parse_settings,
    print_grids,
    table_names,
)
from laser_slam.benchmarks.notes import name_groups, write_notes
from laser_slam.benchmarks.page import Report, put_on_page
from laser_slam.benchmarks.table import FOLDER, Table, parse_table
from laser_slam.errors import ConfigError

TWO = """
    title: two of three
    groups: {all: [a, b, c]}
    rows: {ours: [], other: [windows.size=9]}
    sequences: {a: {reader: synthetic, note: of rooms}, b: {reader: synthetic, note: x}, c: {reader: synthetic}}
    blocks:
      - title: errors
        columns:
          - {name: Avg., measure: ate_m, over: all}
          - {name: A, measure: ate_m, over: a}
          - {name: B, measure: ate_m, over: b}
        published:
          - {method: they, source: a paper, values: [2.50, 0.50, 3.0]}
          - {method: lost, source: a paper, values: [null, 0.6, null]}
"""  # noqa: E501


def ate(name: str, value: float, setting: str = "ours", part: str | None = None) -> Outcome:
    scores = {"run": {"trajectory": {"ate_sim3_m": {"rmse": value}}}}
    return Outcome(setting, name, scores, part=part, backbone="classical")


def printed(table: Table, outcomes: list[Outcome], width: int) -> str:
    console = Console(width=width, file=io.StringIO())
    print_grids(table, fill_grids(table, outcomes), outcomes, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("name", table_names())
def test_published_numbers_have_the_digits_that_their_source_gave(name: str) -> None:
    """502.20 is not 502.2, nor is 1.00 a 1."""
    text = (FOLDER / f"{name}.yaml").read_text()
    as_text = yaml.load(text, yaml.BaseLoader)
    for block, raw in zip(load_table(name).blocks, as_text["blocks"], strict=True):
        for row, raw_row in zip(block.published, raw.get("published", ()), strict=True):
            assert [value or "null" for value in row.values] == raw_row["values"]


def rounding(text: str) -> float:
    return float(0.5 * 10 ** -len(text.partition(".")[2])) * 1.001


@pytest.mark.parametrize("place", [0, 1])
def test_published_means_over_kitti_follow_from_their_rows(place: int) -> None:
    """Of every row, as near as the digits of its source allow; the paper's own all do."""
    num_rows = 0
    for row in load_table("kitti").blocks[0].published:
        values = [value for value in row.values[2:] if value is not None]
        mean = row.values[place]
        if mean is None:
            continue
        chosen = [value for i, value in enumerate(values) if place == 0 or i != 1]
        found = sum(map(float, chosen)) / len(chosen)
        slack = rounding(mean) + sum(map(rounding, chosen)) / len(chosen)
        assert abs(found - float(mean)) <= slack, row.method
        num_rows += 1
    assert num_rows == 20


def test_published_chamfer_is_half_of_accuracy_and_completeness() -> None:
    blocks = load_table("waymo").blocks
    rows = [[row.values for row in block.published] for block in blocks if block.published]
    assert len(rows) == 3
    for acc, comp, chamfer in zip(*rows, strict=True):
        for parts in zip(acc, comp, chamfer, strict=True):
            a, b, c = (float(str(value)) for value in parts)
            assert (a + b) / 2 == pytest.approx(c, abs=0.0011)


def published(table: str, method: str, names: dict[str, str]) -> list[str | None]:
    """Return values of a method, by measure and group."""
    (block,) = (block for block in load_table(table).blocks if block.published)
    (row,) = (row for row in block.published if row.method == method)
    columns = [(column.measure, column.over) for column in block.columns]
    return [row.values[columns.index(place)] for place in names.items()]


def test_what_two_tables_say_of_laser_is_the_same() -> None:
    depth = {f"{name}_{what}": name for name in ("sintel", "bonn") for what in
             ("abs_rel", "delta_percent")}  # fmt: skip
    found = published("ablation", "LASER (pi3)", depth)
    assert found == published("depth", "pi3 + LASER", depth)
    errors = ("ate_m", "rpe_translation_m", "rpe_rotation_deg")
    ablated = published("ablation", "LASER (pi3)", dict.fromkeys(errors, "sintel poses"))
    assert ablated == published("pose", "pi3 + LASER", dict.fromkeys(errors, "sintel"))


def test_ablations_are_of_the_videos_of_the_depth_table() -> None:
    ablation, depth = load_table("ablation"), load_table("depth")
    names = [*depth.groups["sintel"], *depth.groups["bonn"]]
    assert list(ablation.sequences)[:28] == names
    assert [ablation.sequences[name] for name in names] == [depth.sequences[name] for name in names]
    assert ablation.groups["bonn"] == depth.groups["bonn"]


def test_each_table_of_ablations_is_one_word() -> None:
    table = load_table("ablation")
    names = [setting.name for setting in parse_settings(["L", "O"], table)]
    assert names == ["ours", "L 10", "L 40", "O 2", "O 10"]  # what is in both is run once
    grouped = {name for names in table.row_groups.values() for name in names}
    assert grouped == set(table.rows)
    with pytest.raises(ConfigError, match=r"row of the table \(layers, tau, registration"):
        parse_settings(["taw"], table)
    with pytest.raises(ConfigError, match="row group L: no row shorter"):
        parse_table("{title: t, row_groups: {L: [shorter]}, sequences: {}, blocks: []}")


def test_what_cannot_be_borrowed_says_so() -> None:
    for borrowed, words in (
        ("{depht: [sintel]}", "no table 'depht' \\(did you mean depth"),
        ("{depth: [tum]}", "the table depth has no group tum"),
    ):
        with pytest.raises(ConfigError, match=words):
            parse_table(f"{{title: t, borrowed: {borrowed}, sequences: {{}}, blocks: []}}")


def test_floats_that_are_no_published_numbers_are_numbers() -> None:
    text = "{title: t, sequences: {a: {reader: synthetic, arguments: {fps: 29.5}}}, blocks: []}"
    assert parse_table(text).sequences["a"].arguments["fps"] * 2 == 59


@pytest.mark.parametrize("width", [80, 120, 200])
@pytest.mark.parametrize("name", ["kitti", "pose", "ablation"])
def test_every_number_can_be_read_at_any_width(name: str, width: int) -> None:
    """A table that is too wide comes in pieces; no number is cut or folded."""
    table = load_table(name)
    outcomes = [ate(sequence, 123.456) for sequence in list(table.sequences)[:-2]]
    lines = printed(table, outcomes, width).splitlines()
    assert max(map(len, lines)) <= width
    tokens = [re.sub(r" \(\d+ of \d+\)", "", line).split() for line in lines]
    for grid in fill_grids(table, outcomes):
        for row in grid.rows:
            label = row.name.split()
            of_row = [line for line in tokens if line[: len(label)] == label]
            found = [token for line in of_row for token in line]
            for cell in row.cells:
                assert cell.text.partition(" (")[0] in found, (row.name, cell.text)


def test_a_narrow_terminal_gets_every_column_once() -> None:
    table = load_table("kitti")
    lines = printed(table, [ate(name, 1.0) for name in table.sequences], 80).splitlines()
    header = [line.split()[1:] for line in lines if line.startswith("method")]
    num = len(table.blocks[0].columns)
    assert [name for line in header for name in line][:num] == [
        column.name for column in table.blocks[0].columns
    ]


def test_what_was_not_asked_for_has_no_column() -> None:
    table = parse_table(TWO)
    (grid,) = fill_grids(table, [ate("a", 1.0)])
    assert [column.name for column in grid.columns] == ["A"]  # nor has a mean over one
    assert [[cell.text for cell in row.cells] for row in grid.rows] == [
        ["1.000"],
        ["0.50"],
        ["0.6"],
    ]
    (grid,) = fill_grids(table, [ate("b", 1.0)])
    assert [row.name for row in grid.rows] == ["ours", "they"]  # the other says nothing of b
    (grid,) = fill_grids(table, [ate("a", 1.0), ate("b", 3.0)])
    assert [cell.text for cell in grid.rows[0].cells] == ["2.000 (2 of 3)", "1.000", "3.000"]
    (grid,) = fill_grids(table, [ate("c", 1.0)])  # which has no column of its own
    assert [cell.text for cell in grid.rows[0].cells] == ["1.000 (1 of 3)"]


def best(grid: Grid) -> set[tuple[str, str]]:
    return {
        (row.name, column.name)
        for row in grid.rows
        for column, cell in zip(grid.columns, row.cells, strict=True)
        if cell.is_best
    }


def test_the_best_of_complete_numbers_is_marked() -> None:
    table = parse_table(TWO)
    outcomes = [ate("a", 0.4), ate("b", 0.1, part="5 of 9 frames"), ate("c", 0.1)]
    (grid,) = fill_grids(table, outcomes)
    assert best(grid) == {("ours", "A")}  # parts and means over fewer are no competitors
    (grid,) = fill_grids(table, [ate("a", 0.5), ate("b", 4.0), ate("c", 0.1)])
    # Equal as shown is equal; the published row alone has the rest.
    assert best(grid) == {("ours", "A"), ("they", "A"), ("ours", "Avg."), ("they", "B")}
    assert grid.heading == "errors; lower is better"


def test_rows_of_different_sequences_do_not_compete() -> None:
    table = load_table("here")
    outcomes = [ate("kitti-03", 1.0), ate("drive", 2.0)]
    outcomes += [ate("kitti-03", 3.0, "vggt-long"), ate("drive", 0.5, "vggt-long")]
    paths = fill_grids(table, outcomes)[0]
    assert paths.label == "sequence, method"
    assert best(paths) == {("kitti-03, ours", "ATE"), ("drive, vggt-long", "ATE")}
    assert paths.heading == paths.title  # columns differ in what is better
    assert [paths.header(column) for column in paths.columns][:3] == ["frames", "path, m", "ATE ↓"]


def test_a_row_says_with_which_backbone_it_was_run() -> None:
    table = parse_table(TWO)
    mixed = [ate("a", 1.0), Outcome("ours", "b", reason="broken", backbone="pi3")]
    text = as_markdown(table, fill_grids(table, mixed), mixed)
    assert "| **ours (classical, pi3)** |" in text
    lines = list(csv.DictReader(io.StringIO(as_csv("t", fill_grids(table, mixed)))))
    assert {(line["method"], line["backbone"]) for line in lines} == {
        ("ours", "classical, pi3"), ("they", ""), ("lost", "")
    }  # fmt: skip
    assert [line["over"] for line in lines[:3]] == ["all", "a", "b"]


def test_markdown_has_sources_once_and_the_best_in_bold() -> None:
    table = parse_table(TWO)
    outcomes = [ate("a", 0.25), ate("b", 9.0), ate("c", 1.0)]
    text = as_markdown(table, fill_grids(table, outcomes), outcomes)
    assert text.count("a paper") == 1
    assert "\n[1] a paper\n" in text
    assert "| **ours (classical)** | 3.417 | **0.250** | 9.000 |" in text
    assert "| they [1] | **2.50** | 0.50 | **3.0** |" in text
    assert "| lost [1] | - | 0.6 | - |" in text


def test_notes_name_groups_and_leave_out_rows_where_all_are_meant() -> None:
    table = load_table("kitti")
    lost = [Outcome(row, name, reason="no data") for row in ("ours", "b") for name in
            table.sequences]  # fmt: skip
    assert write_notes(table, [], lost) == ["all (11): no data"]
    some = [Outcome("b", "00", reason="no weights"), ate("00", 1.0), ate("00", 2.0, "c")]
    assert write_notes(table, [], some) == ["00 (b): no weights"]
    assert write_notes(table, [], [ate("00", 1.0)]) == []


def test_notes_name_large_groups_that_lack_a_few() -> None:
    table = load_table("pose")
    sequences = list(table.sequences)
    asked = "scannet-scene0707_00"
    others = [name for name in sequences if name != asked]
    text = f"sintel (14), tum (8), scannet (99 of 100, not {asked})"
    assert ", ".join(name_groups(others, table.groups)) == text
    few = load_table("kitti")
    assert name_groups(list(few.sequences)[1:], few.groups) == list(few.sequences)[1:]


def test_the_csv_has_each_sequence_of_a_mean_also_where_only_a_part_is_there() -> None:
    table = parse_table(TWO)
    outcomes = [ate("a", 1.0), ate("c", 4.0, part="3 of 9 frames")]
    grids = fill_grids(table, outcomes)
    lines = [
        line
        for line in csv.DictReader(io.StringIO(as_csv("t", grids)))
        if line["source"] == "this run"
    ]
    told = [(line["over"], line["value"], line["notes"]) for line in lines]
    assert told[0][:2] == ("all", "1.0")  # of which a is, which has a column for itself
    assert told[1] == ("c", "4.0", "only a part is there: 3 of 9 frames")
    assert [over for over, _, _ in told] == ["all", "c", "a"]
    text = "c: only a part is there: 3 of 9 frames; in no mean, its numbers are in the CSV"
    assert text in write_notes(table, grids, outcomes)
    marked = [ate("a", 1.0, part="3 of 9 frames")]
    assert "a: *: only a part is there: 3 of 9 frames" in write_notes(
        table, fill_grids(table, marked), marked
    )


def test_notes_say_what_numbers_are_not_over() -> None:
    scores = {"run": {"trajectory": {"num_frames": 40, "num_truth": 90}}}
    notes = write_notes(load_table("kitti"), [], [Outcome("ours", "00", scores)])
    assert len(notes) == 1
    assert notes[0].startswith("00: 50 of 90 frames")


def test_a_section_tells_only_of_what_was_run() -> None:
    table = parse_table(TWO)
    report = Report("t", table, [Setting("ours")], [ate("a", 1.0)], "laser-slam bench t")
    text = report.section(fill_grids(table, [ate("a", 1.0)]))
    assert "- a: of rooms" in text
    assert "- b: x" not in text
    assert "- **ours**: as all rows are" in text
    assert "\n\n\n" not in text


def test_a_section_tells_what_settings_its_sequences_need() -> None:
    table = load_table("here")
    asked = [ate(name, 1.0) for name in ("office", *table.groups["paths"])]
    text = Report("here", table, [Setting("ours")], asked, "").section(fill_grids(table, asked))
    assert "the loops are what counts; `dataset.fps=30.0`\n- paths (11): `backbone.name=sim" in text


def test_a_page_gets_the_words_of_today_and_keeps_the_tables_of_others(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    put_on_page(page, "a", "## A\n\n1")
    head, _, _ = page.read_text().partition("\n<!-- bench a -->")
    page.write_text(page.read_text().replace("no number by hand", "and so on"))
    put_on_page(page, "b", "## B\n\n2")
    text = page.read_text()
    assert text.startswith(head)
    assert "and so on" not in text
    assert text.count("<!-- bench a -->\n## A\n\n1\n<!-- end of bench a -->") == 1
    assert "## B" in text
    page.write_text("# My own words\n")
    put_on_page(page, "b", "## B\n\n2")
    assert page.read_text().startswith("# My own words\n\n<!-- bench b -->\n## B")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{title: t, blocks: []}", "mine.yaml: sequences: Field required"),
        ("title: [", "mine.yaml is no YAML"),
        ("{title: t, sequences: {}, blocks: [], colour: red}", "colour: Extra inputs"),
        (TWO.replace("over: a}", "over: z}"), "mine.yaml: no sequences z"),
        (TWO.replace("ate_m, over: a}", "ate, over: a}"), "no measure ate; there is ate_m"),
        (TWO.replace("{reader: synthetic, note: x}", "{reader: tum-rgbd}"), "tum-rgbd needs 'at'"),
        ("{title: t, borrowed: [kitti], sequences: {}, blocks: []}", "borrowed: wants a table's"),
    ],
)
def test_a_table_of_ones_own_that_is_wrong_says_where(
    text: str, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_table(str(path))
    assert words in str(error.value)
    path.write_text(TWO)
    assert load_table(str(path)).title == "two of three"
    with pytest.raises(ConfigError, match="cannot read the table"):
        load_table(str(tmp_path / "no.yaml"))
