"""The page of a run: whole, self-contained, and right whatever the run lacks."""

import copy
import html.parser
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from browser import Browser
from corridor import Corridor, TrueBackbone
from quick_runs import leave_pictures_out
from ring import NUM_FRAMES, TIMES_S, Drift, black, chain, prediction_of, ring_pose, true_link
from typer.testing import CliRunner

from laser_slam.cli import app
from laser_slam.closures import ClosureRecord
from laser_slam.config import load_config
from laser_slam.errors import RunFolderError
from laser_slam.evaluation.trajectory import evaluate_trajectory
from laser_slam.layers import LayerCounts
from laser_slam.pipeline import Pipeline
from laser_slam.places.similarity import SimilarityMap
from laser_slam.report.html_charts import BOX, Axis, Line, line_chart, plan_chart
from laser_slam.report.html_pictures import embed
from laser_slam.rescoring import rescore
from laser_slam.results import (
    Findings,
    Loops,
    Scores,
    describe_course,
    describe_layers,
    describe_loops,
    describe_sequence,
    describe_system,
    describe_windows,
    draw_findings,
    write_report,
    write_report_page,
)
from laser_slam.results.paths import MAX_POINTS, describe_paths
from laser_slam.store import WindowFiles
from laser_slam.types import NO_DISTORTION, Calibration, Cloud, Trajectory

CONFIG = load_config(
    assignments=["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"]
)
DRIFT = Drift(seed=1)
CLOSED = [(0, 18), (1, 19), (3, 21)]
GOOD = ClosureRecord(0, 18, 3, 93, 0.51, "accepted", 200, 3, 400, 0.02, 1.1, 1.0, 2.0)
BAD = replace(GOOD, frame_b=94, verdict="depths differ by 0.31, at most 0.15")
EVIL = "<script>alert(\"1\")</script> & <b>bold</b> 'x'"
VOID = {"meta", "img", "br", "link", "input", "hr"}
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Parsed(html.parser.HTMLParser):
    """Check that tags are balanced, and keep what tests ask for."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names)), attrs
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert "svg" in self._open, f"<{tag}/> outside of a drawing"
        self.handle_starttag(tag, attrs)
        self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self._open:
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


def page_of(folder: Path) -> Parsed:
    write_report_page(folder)
    return Parsed((folder / "report.html").read_text(encoding="utf-8"))


def truth() -> Trajectory:
    frames = np.arange(NUM_FRAMES)
    return Trajectory(frames, TIMES_S[frames], np.stack([ring_pose(int(i)) for i in frames]))


def report_of(found: Findings, slam: Any, loops: Loops | None) -> dict[str, Any]:
    """Say of the drive in circles what a run says."""
    errors = found.scores.trajectory
    info = Corridor().info
    calibration = Calibration(info.intrinsics, NO_DISTORTION, info.size, "given")
    nodes = [replace(n, layers=LayerCounts(9, 4, 1, 8, 0, 0, 0.05, 0.02)) for n in slam.nodes]
    return {
        "sequence": describe_sequence(info, calibration, [np.eye(3)]) | {"name": "ring"},
        "frames": {"read": NUM_FRAMES, "unreadable": 2, "keyframes": 100},
        "windows": describe_windows(slam, found) | {"bridged": {"7": "the camera only turns"}},
        "trajectory": errors.numbers() if errors else None,
        "paths": describe_course(found),
        "depth": None,
        "depth_without_layers": None,
        "layers": describe_layers(nodes),
        "closures": describe_loops(loops),
        "map": {"num_points": len(found.cloud.points), "voxel_size": 0.02},
        "warnings": ["frame 4 cannot be read", "frame 5 cannot be read", "the map is thin"],
        "seconds": {"wall": {"read": 1.0, "fuse": 3.0}, "cpu": {"read": 0.5}, "wall_in_all": 4.0},
        "frames_per_second": 29.5,
        **describe_system(),
        "settings": CONFIG.model_dump(mode="json"),
    }


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Leave the folder of a drive in circles, with loops, truth and all pictures."""
    folder = tmp_path_factory.mktemp("runs") / "full"
    (folder / "pictures").mkdir(parents=True)
    (folder / "windows").mkdir()
    slam = chain(DRIFT)
    chained = slam.trajectory(TIMES_S)
    for a, b in CLOSED:
        assert slam.close(a, b, *true_link(a, b, DRIFT.seed))
    closed, files = slam.trajectory(TIMES_S), WindowFiles(folder)
    for window in (0, 18):
        files.save(window, prediction_of(window, DRIFT), black())
    nothing = SimilarityMap(np.zeros((0, 0), np.float32), np.zeros(0, np.int64), 1)
    errors = evaluate_trajectory(closed, truth())
    loops = Loops(
        [BAD, GOOD], 0, nothing, chained, truth(), evaluate_trajectory(chained, truth()), {}
    )
    points = np.random.default_rng(0).normal(size=(2000, 3))
    cloud = Cloud(points, np.full((2000, 3), 90, np.uint8), np.ones(2000, np.float32), 0.02)
    found = Findings(closed, cloud, Scores(errors, None, None, []), loops, truth())
    draw_findings(folder / "pictures", found, slam.nodes, files)
    write_report(folder / "report.json", report_of(found, slam, loops))
    return folder


@pytest.fixture
def bare(full: Path, tmp_path: Path) -> Path:
    """Leave the report alone, without its pictures."""
    shutil.copy(full / "report.json", tmp_path)
    return tmp_path


def read(folder: Path) -> Any:
    return json.loads((folder / "report.json").read_text(encoding="utf-8"))


def change(folder: Path, **parts: Any) -> None:
    write_report(folder / "report.json", read(folder) | parts)


# --- the file -----------------------------------------------------------------------------------


def test_the_page_is_valid_and_needs_nothing_but_itself(full: Path) -> None:
    page = page_of(full)
    assert [name for name, _ in page.tags if name in {"script", "link", "iframe", "object"}] == []
    sources = [a[k] for _, a in page.tags for k in ("src", "srcset", "data", "poster") if k in a]
    assert len(sources) >= 7
    assert all(source.startswith("data:image/") for source in sources)
    text = (full / "report.html").read_text()
    assert not re.findall(r"url\(|@import|https?:", text)
    assert "default-src 'none'" in text
    ids = Counter(a["id"] for _, a in page.tags if "id" in a)
    assert max(ids.values()) == 1
    for link in page.all("a"):
        target = link["href"]
        assert target[1:] in ids if target.startswith("#") else (full / target).exists()


def test_pictures_and_charts_say_what_they_show(full: Path) -> None:
    page = page_of(full)
    assert all(len(image["alt"]) > 6 for image in page.all("img"))
    drawings = [a for a in page.all("svg") if a.get("role") == "img"]
    assert len(drawings) >= 5
    assert all(re.search(r"\d", drawing["aria-label"]) for drawing in drawings)
    levels = [name for name, _ in page.tags if name in {"h1", "h2", "h3"}]
    assert levels[0] == "h1"
    assert levels.count("h1") == 1
    assert {"main", "header", "footer", "nav"} <= {name for name, _ in page.tags}


def test_the_page_says_the_numbers_of_the_report(full: Path) -> None:
    text, report = page_of(full).text, read(full)
    assert "ring" in text
    assert f"{report['trajectory']['ate_sim3_m']['rmse']:.3f} m" in text
    without = report["closures"]["trajectory_without"]["ate_sim3_m"]["rmse"]
    assert f"{without:.3g} m without loops" in text
    assert "1 of 2 candidates were closed" in text
    assert "windows.size 8 20 keyframes per window" in text
    assert "the camera only turns" in text
    assert "frame 4 cannot be read (and 1 more like it)" in text
    assert "no true depth to compare with" in text
    assert "fuse 3.0 75.0 %" in text
    assert "layers.refused 23" in text
    assert "closures.refused (entries) 1" in text


def test_closed_loops_come_before_rejected_ones_and_show_their_images(full: Path) -> None:
    page = page_of(full)
    alts = [image["alt"] for image in page.all("img")]
    assert alts.count("Frame 3") == 2
    assert (alts.count("Frame 93"), alts.count("Frame 94")) == (1, 1)
    assert page.text.index("frames 3 and 93") < page.text.index("frames 3 and 94")
    assert page.text.index("3 – 93") < page.text.index("3 – 94")


def test_text_from_outside_is_escaped(bare: Path) -> None:
    report = read(bare)
    records = [report["closures"]["records"][0] | {"verdict": EVIL, "source": EVIL}]
    change(
        bare,
        sequence=report["sequence"] | {"name": EVIL, "calibration": EVIL},
        warnings=[EVIL],
        closures=report["closures"] | {"records": records, "refused": {EVIL: 1}},
        windows=report["windows"] | {"bridged": {"1": EVIL}, "unit": EVIL},
        settings={EVIL: EVIL},
        seconds={"wall": {EVIL: 1.0}},
        versions={EVIL: EVIL},
        paths=report["paths"] | {"unit": EVIL},
    )
    (bare / "a <b> & 'c'.txt").write_text("")
    page = page_of(bare)
    assert {"script", "b"} & {name for name, _ in page.tags} <= {"b"}
    assert page.text.count(EVIL) >= 8
    assert "<b>bold" not in (bare / "report.html").read_text()


def test_the_largest_page_stays_small(bare: Path) -> None:
    rng, report = np.random.default_rng(0), read(bare)
    (bare / "pictures" / "frames").mkdir(parents=True)
    names = [f"map_{v}{s}" for v in ("above", "bird", "driver") for s in ("", "_unfiltered")]
    for name in [*names, "depth", "layers", "similarity"]:
        noise = rng.integers(0, 256, (560, 560, 3), np.uint8)
        PIL.Image.fromarray(noise).save(bare / "pictures" / f"{name}.png")
    for frame in range(60):
        noise = rng.integers(0, 256, (150, 200, 3), np.uint8)
        PIL.Image.fromarray(noise).save(bare / "pictures" / "frames" / f"{frame:06d}.jpg")
    row = report["closures"]["records"][0]
    records = [row | {"frame_a": i % 60, "frame_b": (i + 7) % 60} for i in range(3000)]
    column = np.linspace(0, 9, MAX_POINTS).tolist()
    path = {"frames": list(range(MAX_POINTS)), "x": column, "z": column}
    window = report["windows"]["records"][3]
    change(
        bare,
        closures=report["closures"] | {"records": records},
        warnings=[f"{'word ' * 20} {chr(97 + i % 26) * (i // 26)}" for i in range(5000)],
        paths=report["paths"] | {"estimate": path, "without_loops": path, "truth": path},
        windows=report["windows"] | {"records": [window] * 2000},
    )
    page = page_of(bare)
    assert (bare / "report.html").stat().st_size < 8e6
    assert len(page.all("img")) == 9 + 2 * 24


def contrast(first: str, second: str) -> float:
    """Return the WCAG contrast of two colours, #rgb or #rrggbb."""

    def luminance(color: str) -> float:
        digits = color[1:] if len(color) == 7 else "".join(2 * digit for digit in color[1:])
        levels = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255
        linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    dark, light = sorted((luminance(first), luminance(second)))
    return (light + 0.05) / (dark + 0.05)


def test_text_and_lines_stand_out_from_the_paper_in_light_and_in_dark(bare: Path) -> None:
    write_report_page(bare)
    text = (bare / "report.html").read_text()
    roots = re.findall(r":root \{(.*?)\}", text, re.DOTALL)[:2]
    schemes = [dict(re.findall(r"--([a-z-]+): (#[0-9a-f]+)", root)) for root in roots]
    assert len(schemes) == 2
    for colors in schemes:
        assert contrast(colors["warn"], colors["warn-soft"]) > 4.5
        for name in ("ink", "muted", "link", "without", "estimate", "accepted", "rejected"):
            assert contrast(colors[name], colors["paper"]) > 4.5, name


# --- what a run may lack ------------------------------------------------------------------------


def places(value: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Name all values of a report but the later items of its lists."""
    if above:
        yield above
    items: dict[Any, Any] = value if isinstance(value, dict) else {}
    if isinstance(value, list) and value:
        items = {0: value[0]}
    for key, inner in items.items():
        yield from places(inner, (*above, key))


def without(report: Any, place: tuple[Any, ...]) -> Iterator[Any]:
    """Give the report with null in a place, and, in a dictionary, without the place."""
    for is_removed in (False, True):
        changed = copy.deepcopy(report)
        inner = changed
        for key in place[:-1]:
            inner = inner[key]
        if not is_removed:
            inner[place[-1]] = None
        elif isinstance(inner, dict):
            del inner[place[-1]]
        yield changed


def test_any_value_of_the_report_may_be_null_or_missing(bare: Path) -> None:
    report = read(bare)
    report["settings"] = {"windows": report["settings"]["windows"]}
    report["windows"]["records"] = report["windows"]["records"][:4]
    report["layers"]["windows"] = dict(list(report["layers"]["windows"].items())[:2])
    report["closures"]["sigmas"] = None
    tried = 0
    for place in places(report):
        for changed in without(report, place):
            (bare / "report.json").write_text(json.dumps(changed))
            try:
                write_report_page(bare)
            except Exception as error:
                raise AssertionError(f"{place}: {error!r}") from error
            tried += 1
    assert tried > 300


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"trajectory": None, "paths": None}, "no true poses to compare with"),
        ({"closures": None}, "Loops were not looked for"),
        ({"map": {"num_points": 0, "voxel_size": 0.0}}, "the map is empty"),
        ({"trajectory": {"reason": "the true path stays in one place"}}, "stays in one place"),
        ({"peak_memory_mib": None}, "this system does not tell"),
        ({"settings": load_config().model_dump(mode="json")}, "All settings are the defaults"),
    ],
)
def test_what_is_unknown_says_why(bare: Path, parts: dict[str, Any], words: str) -> None:
    change(bare, **parts)
    assert words in page_of(bare).text


def test_counters_of_new_parts_are_listed(bare: Path) -> None:
    change(bare, predictions={"hits": 17, "all": [1, 2, 3]}, tiles=4)
    text = page_of(bare).text
    for words in ("predictions.hits 17", "predictions.all (entries) 3", "tiles 4"):
        assert words in text


def test_counters_have_marks_at_their_thousands(bare: Path) -> None:
    change(bare, map={"num_points": 4378311, "voxel_size": 0.02, "is_whole": True})
    text = page_of(bare).text
    assert "map.num_points 4,378,311 map.voxel_size 0.02 map.is_whole true" in text


def test_sigmas_apart_have_a_column_where_a_closure_was_measured_twice(bare: Path) -> None:
    closures = read(bare)["closures"]
    for sigmas in (6543.0, None):
        records = [row | {"disagreement": None} for row in closures["records"]]
        records[-1]["disagreement"] = sigmas
        change(bare, closures=closures | {"records": records})
        text = page_of(bare).text
        assert ("sigmas apart" in text) == ("6,543" in text) == (sigmas is not None)


def test_every_file_of_a_run_says_what_it_holds(bare: Path) -> None:
    for name in ("run.rrd", "keyframes.npz", "frames.npz", "images.json", "predictions.yaml"):
        (bare / name).write_text("x")
    (bare / "tiles").mkdir()
    (bare / "tiles" / "index.json").write_text("x")
    text = page_of(bare).text
    assert "run.rrd 1 B the recording that rerun shows" in text
    assert "keyframes.npz 1 B where the keyframes lie" in text
    assert "frames.npz 1 B times of the frames" in text
    assert "images.json 1 B the files of the input" in text
    assert "predictions.yaml 1 B what the windows' predictions were made with" in text
    assert "tiles/ 1 B 1 file: the map in parts" in text


def test_a_path_too_short_for_kittis_scores_says_so(bare: Path) -> None:
    trajectory = read(bare)["trajectory"]
    nothing = {"t_rel_percent": None, "r_rel_deg_per_100m": None, "num_segments": 0}
    change(bare, trajectory=trajectory | {"kitti": nothing, "path_length_m": 12.5})
    text = page_of(bare).text
    assert "the path of 12.5 m has no segment of 100 m" in text
    assert "KITTI's t_rel and r_rel need segments of 100 m" in text


def test_a_report_of_nothing_still_gives_a_page(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text("{}")
    page = page_of(tmp_path)
    assert tmp_path.name in page.text
    assert "no true poses" in page.text


def test_pictures_of_an_older_run_stand_in_for_charts(full: Path, tmp_path: Path) -> None:
    shutil.copytree(full / "pictures", tmp_path / "pictures")
    report = read(full)
    del report["paths"]
    report["windows"] = {"num": 23, "bridged": {}}
    (tmp_path / "report.json").write_text(json.dumps(report))
    titles = {image["alt"] for image in page_of(tmp_path).all("img")}
    assert {"Trajectory from above", "Scale of the windows over the distance"} <= titles


def test_a_damaged_picture_is_left_out(full: Path, tmp_path: Path) -> None:
    shutil.copytree(full, tmp_path / "run")
    path = tmp_path / "run" / "pictures" / "map_bird.png"
    path.write_bytes(path.read_bytes()[:2000])
    (tmp_path / "run" / "pictures" / "map_above.png").write_text("no picture")
    alts = [image["alt"] for image in page_of(tmp_path / "run").all("img")]
    assert not [alt for alt in alts if alt.startswith(("From above", "Oblique"))]
    assert [alt for alt in alts if alt.startswith("From the driver's seat")]


def test_an_unfiltered_map_stands_beside_the_filtered_one(full: Path, tmp_path: Path) -> None:
    shutil.copytree(full, tmp_path / "run")
    pictures = tmp_path / "run" / "pictures"
    shutil.copy(pictures / "map_bird.png", pictures / "map_bird_unfiltered.png")
    assert "Oblique Oblique, unfiltered" in page_of(tmp_path / "run").text


def test_a_picture_that_no_part_asks_for_is_shown_too(full: Path, tmp_path: Path) -> None:
    shutil.copytree(full, tmp_path / "run")
    before = len(page_of(tmp_path / "run").all("img"))
    pictures = tmp_path / "run" / "pictures"
    shutil.copy(pictures / "map_bird.png", pictures / "point_errors.png")
    page = page_of(tmp_path / "run")
    assert len(page.all("img")) == before + 1
    assert "Point errors" in page.text


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no finished run"), ("{", "is damaged"), ("[]", "is no report")],
)
def test_a_folder_without_report_is_refused(
    tmp_path: Path, content: str | None, message: str
) -> None:
    if content is not None:
        (tmp_path / "report.json").write_text(content)
    with pytest.raises(RunFolderError, match=message):
        write_report_page(tmp_path)
    assert not (tmp_path / "report.html").exists()


# --- the run itself -----------------------------------------------------------------------------


def test_a_run_and_a_new_truth_rewrite_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_pictures_out(monkeypatch)
    Pipeline(Corridor(36), CONFIG, tmp_path / "run", backbone=TrueBackbone()).run()
    page = page_of(tmp_path / "run")
    assert "corridor" in page.text
    assert "36 frames" in page.text
    length = read(tmp_path / "run")["trajectory"]["path_length_m"]
    assert f"over {length:.1f} m" in page.text
    table = np.loadtxt(tmp_path / "run" / "truth_tum.txt")
    table[:, 1:4] *= 3
    np.savetxt(tmp_path / "larger.txt", table)
    report = rescore(tmp_path / "run", tmp_path / "larger.txt")
    text = Parsed((tmp_path / "run" / "report.html").read_text()).text
    assert f"over {3 * length:.1f} m" in text
    assert max(report["paths"]["truth"]["z"]) == pytest.approx(table[:, 3].max(), abs=0.01)


def test_a_missing_page_is_written_again_without_a_truth(bare: Path) -> None:
    before = (bare / "report.json").read_bytes()
    done = CliRunner().invoke(app, ["eval", str(bare)])
    assert done.exit_code == 0, done.output
    assert "ring" in Parsed((bare / "report.html").read_text()).text
    assert (bare / "report.json").read_bytes() == before
    refused = CliRunner().invoke(app, ["eval", str(bare)])
    assert refused.exit_code == 1
    assert "had no truth; pass a file of poses with --truth" in " ".join(refused.output.split())


def test_another_truth_moves_the_windows_scales_into_its_metres(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_pictures_out(monkeypatch)
    folder = tmp_path / "run"
    Pipeline(Corridor(36), CONFIG, folder, backbone=TrueBackbone()).run()
    row = {"distance": 2.0, "scale": 3.0, "scale_without_loops": 4.0, "true_scale": 3.1}
    change(folder, windows={"num": 1, "bridged": {}, "unit": "m", "records": [row]})
    same = rescore(folder)["windows"]["records"][0]
    assert {name: pytest.approx(value, rel=1e-5) for name, value in row.items()} == same
    table = np.loadtxt(folder / "truth_tum.txt")
    table[:, 1:4] *= 3
    np.savetxt(tmp_path / "larger.txt", table)
    moved = rescore(folder, tmp_path / "larger.txt")["windows"]
    expected = {"distance": 6.0, "scale": 9.0, "scale_without_loops": 12.0}
    found = moved["records"][0]
    assert {name: pytest.approx(value, rel=1e-5) for name, value in expected.items()} == {
        name: found[name] for name in expected
    }
    assert found["true_scale"] is None
    change(folder, windows=moved | {"unit": "world units"}, closures=None)
    again = rescore(folder)
    scale = again["trajectory"]["scale"]
    assert again["windows"]["records"][0]["scale"] == pytest.approx(9.0 * scale, rel=1e-5)
    assert again["windows"]["unit"] == "m"


# --- the numbers behind the charts --------------------------------------------------------------


def test_the_report_keeps_the_paths_as_they_lie_on_the_truth(full: Path) -> None:
    paths = read(full)["paths"]
    assert paths["unit"] == "m"
    true = truth().world_from_cam[:, :3, 3]
    np.testing.assert_allclose(paths["truth"]["x"], true[:, 0], atol=1e-3)
    np.testing.assert_allclose(paths["truth"]["z"], true[:, 2], atol=1e-3)
    off = {
        name: np.hypot(
            np.array(paths[name]["x"]) - paths["truth"]["x"],
            np.array(paths[name]["z"]) - paths["truth"]["z"],
        ).mean()
        for name in ("estimate", "without_loops")
    }
    assert off["estimate"] < 0.5 * off["without_loops"]
    error = np.array(paths["errors"]["estimate"]["error_m"])
    rmse = read(full)["trajectory"]["ate_sim3_m"]["rmse"]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(rmse, rel=1e-3)


def test_without_truth_paths_stay_in_world_units() -> None:
    path = truth()
    paths = describe_paths(path, None, None, (None, None))
    assert (paths["unit"], paths["truth"], paths["without_loops"]) == ("world units", None, None)
    assert paths["errors"] == {"estimate": None, "without_loops": None}
    np.testing.assert_allclose(paths["estimate"]["x"], path.world_from_cam[:, 0, 3], atol=1e-3)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_long_paths_are_thinned_to_their_ends_and_keep_five_digits(unit: float) -> None:
    num = 5 * MAX_POINTS
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, 0, 3] = unit * np.linspace(0, 7, num)
    path = Trajectory(np.arange(num), np.arange(num) / 10, poses)
    kept = describe_paths(path, None, None, (None, None))["estimate"]
    assert len(kept["frames"]) == MAX_POINTS
    assert (kept["frames"][0], kept["frames"][-1]) == (0, num - 1)
    np.testing.assert_allclose(kept["x"], poses[kept["frames"], 0, 3], atol=1e-4 * unit)


def test_each_window_tells_its_registration_and_scale(full: Path) -> None:
    windows = read(full)["windows"]
    assert len(windows["records"]) == windows["num"]
    first, *others = windows["records"]
    assert first["registration"] is None
    for row in others:
        assert 0 <= row["registration"]["residual"] < 0.1
        assert row["registration"]["num_pixels"] >= 100
    shares = [row["scale"] / row["true_scale"] for row in others]
    assert np.median(np.abs(np.array(shares) - 1)) < 0.03


def test_lists_of_numbers_stay_on_one_line_of_the_report(tmp_path: Path) -> None:
    report = {
        "path": [1, -2.5, 3e-7, None, float("nan")],
        "text": ["[ 1, 2 ]", "a\n[\n 1\n]"],
        "pairs": [[1, 2], [3, 4]],
        "none": [],
    }
    write_report(tmp_path / "report.json", report)
    text = (tmp_path / "report.json").read_text()
    assert '"path": [1, -2.5, 3e-07, null, null],' in text
    assert read(tmp_path) == report | {"path": [1, -2.5, 3e-7, None, None]}


# --- charts and pictures ------------------------------------------------------------------------


def numbers(path: str) -> np.ndarray:
    return np.array([float(text) for text in re.findall(r"-?[\d.]+", path)]).reshape(-1, 2)


def test_a_line_fills_its_chart_and_has_a_gap_where_nothing_is_known() -> None:
    x, y = np.arange(6.0), np.array([0, 1, np.nan, 3, 4, 5])
    axes = Axis("window", is_whole=True), Axis("%", is_percent=True, has_zero=True)
    chart = line_chart("title", "alt", [Line("a", "estimate", x, y, is_marked=True)], *axes)
    stroke = chart.strokes[0]
    assert (stroke.path.count("M"), stroke.path.count("L"), stroke.dots.count("M")) == (2, 3, 5)
    places = numbers(stroke.path)
    assert places[0].tolist() == [0, BOX]
    assert 0 < places[-1, 1] < 0.1 * BOX
    assert [tick.text for tick in chart.y_ticks][:2] == ["0 %", "200 %"]
    assert all("." not in tick.text for tick in chart.x_ticks)


def test_a_plan_has_equal_axes_and_looks_forward_upwards() -> None:
    angle = np.linspace(0, 2 * np.pi, 100)
    line = Line("", "estimate", 5 * np.cos(angle) + 100, 10 * np.sin(angle))
    chart = plan_chart("title", "alt", [line], "m")
    width, height = np.ptp(numbers(chart.strokes[0].path), axis=0)
    assert chart.aspect * width / height == pytest.approx(0.5, rel=0.01)
    assert numbers(chart.strokes[0].path)[25, 1] < BOX / 4


@pytest.mark.parametrize(
    "values", [[], [np.nan], [0.0], [5.0, 5.0], [1e-9, 3e-9], [1e9, -1e9], [-3.0, -3.0]]
)
@pytest.mark.parametrize("has_zero", [True, False])
def test_charts_of_odd_values_stay_finite(values: list[float], has_zero: bool) -> None:
    y = np.array(values, np.float64)
    lines = [Line("a", "estimate", np.arange(len(y)) * 1.0, y, is_marked=True)]
    for chart in (
        line_chart("t", "alt", lines, Axis("x"), Axis("y", has_zero=has_zero)),
        plan_chart("t", "alt", lines, "m"),
    ):
        text = chart.strokes[0].path + chart.strokes[0].dots
        assert "nan" not in text
        assert "inf" not in text
        assert 1 <= len(chart.y_ticks) < 12
        assert all(0 <= tick.percent <= 100 for tick in [*chart.x_ticks, *chart.y_ticks])


def test_embedded_pictures_are_small_and_drawings_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (900, 1400, 3), np.uint8)
    PIL.Image.fromarray(noise).save(tmp_path / "noise.png")
    found = embed(tmp_path / "noise.png", 1000, 100_000)
    assert found is not None
    assert len(found.uri) < 4 / 3 * 100_000 + 100
    assert found.width / found.height == pytest.approx(1400 / 900, rel=0.02)
    drawing = np.full((200, 300, 3), 255, np.uint8)
    drawing[50:60] = (200, 30, 30)
    PIL.Image.fromarray(drawing).save(tmp_path / "drawing.png")
    exact = embed(tmp_path / "drawing.png", 1000, 100_000)
    assert exact is not None
    assert (exact.width, exact.height) == (300, 200)
    assert len(exact.uri) < 1000
    assert embed(tmp_path / "missing.png", 1000, 1000) is None


# --- in a browser -------------------------------------------------------------------------------


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, for how the page looks")
def test_a_browser_shows_the_page_without_scrolling_sideways_or_asking_for_anything(
    full: Path, bare: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    change(bare, sequence=read(bare)["sequence"] | {"name": "a_name_without_any_space" * 9})
    page_of(full)
    page_of(bare)
    papers = {}
    with Browser(str(CHROMIUM), tmp_path_factory.mktemp("profile")) as browser:
        for page in (full / "report.html", bare / "report.html"):
            for width, scheme in ((1280, "light"), (390, "light"), (390, "dark")):
                browser.open(page, width, scheme)
                browser.evaluate("for (const d of document.querySelectorAll('details')) d.open = 1")
                assert browser.evaluate("document.documentElement.scrollWidth") <= width
                assert "Settings that differ" in browser.evaluate("document.body.innerText")
                broken = "[...document.images].filter(i => !i.naturalWidth).length"
                assert browser.evaluate(broken) == 0
                paper = "getComputedStyle(document.body).backgroundColor"
                papers[scheme] = browser.evaluate(paper)
                asked = [url for url in browser.requested() if not url.startswith("data:")]
                assert asked == [page.resolve().as_uri()]
                assert browser.complaints() == []
    assert papers["light"] == "rgb(255, 255, 255)"
    assert papers["dark"] != papers["light"]
