"""The page's pictures of path and map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.report.html import Block, Charts, Picture, Pictures, Section, Text
from laser_slam.report.html_charts import Axis, Chart, Line, Role, line_chart, plan_chart
from laser_slam.report.html_pictures import embed
from laser_slam.results.page.reading import (
    Report,
    column,
    count,
    look,
    number,
    records,
    say,
    series,
)

WIDTH_PX, MAX_BYTES = 1200, 330_000  # of a picture in the page, before it becomes text
_VIEWS = (
    ("map_above", "From above"),
    ("map_bird", "Oblique"),
    ("map_driver", "From the driver's seat"),
)
_MAX_LINKS = 60  # rejected ones; more would hide the path
_UNFILTERED = "_unfiltered"
_MAX_OTHERS = 4  # pictures that no part of the page asks for
_DRAWN = (  # for a report of an older version
    ("trajectory", "Trajectory from above"),
    ("loops", "Trajectory without and with loops"),
    ("drift", "Drift over the distance travelled"),
)


def find_picture(folder: Path, name: str, title: str, alt: str) -> Picture | None:
    """Embed the picture ``name`` of a run's folder; None: there is none that can be read."""
    image = embed(folder / "pictures" / f"{name}.png", WIDTH_PX, MAX_BYTES)
    return None if image is None else Picture(image, title, alt)


def world_map(report: Report, folder: Path) -> Section:
    """Show the map from all sides, beside the unfiltered one where that was drawn."""
    points = count(number(report, "map.num_points"))
    shown: dict[str, list[Picture]] = {}
    for name, title in _VIEWS:
        alt = f"{title}: the map of {points or 'unknown'} points in its own colours"
        raw = f"{alt}, before any point was filtered"
        found = [
            find_picture(folder, name, title, alt),
            find_picture(folder, name + _UNFILTERED, f"{title}, unfiltered", raw),
        ]
        shown[name] = [picture for picture in found if picture is not None]
    blocks: list[Block] = [Pictures(each, "two") for each in shown.values() if len(each) == 2]
    alone = [each[0] for each in shown.values() if len(each) == 1]
    if alone:
        blocks.append(Pictures(alone, "lead" if len(alone) > 2 else "two"))
    if not blocks:
        blocks.append(Text("No pictures of the map were drawn."))
    return Section("map", "Map", blocks)


def trajectory(report: Report, folder: Path) -> Section:
    """Show the path from above: truth, before and after the closures, and what they joined."""
    chart = _plan(report)
    if chart is not None:
        return Section("trajectory", "Trajectory", [Charts([chart, *error_charts(report)], 2)])
    drawn = [find_picture(folder, name, title, title) for name, title in _DRAWN]
    pictures = [picture for picture in drawn if picture is not None]
    return Section("trajectory", "Trajectory", [Pictures(pictures)] if pictures else [])


def _plan(report: Report) -> Chart | None:
    names: tuple[tuple[str, str, Role], ...] = (
        ("truth", "truth", "truth"),
        ("without_loops", "without loops", "without"),
        ("estimate", "estimate", "estimate"),
    )
    lines = [
        Line(label, role, x, z)
        for name, label, role in names
        if len(x := series(report, f"paths.{name}.x"))
        == len(z := series(report, f"paths.{name}.z"))
        and len(x)
    ]
    if not lines or lines[-1].label != "estimate":
        return None
    if not number(report, "closures.accepted"):
        lines = [line for line in lines if line.role != "without"]
        lines[-1:] = [Line("estimate", "estimate", lines[-1].x, lines[-1].y)]
    links = _links(report)
    start = Line(
        "start", "start", lines[-1].x[:1], lines[-1].y[:1], is_marked=True, is_joined=False
    )
    end = Line("end", "end", lines[-1].x[-1:], lines[-1].y[-1:], is_marked=True, is_joined=False)
    unit = str(look(report, "paths.unit") or "world units")
    title = "From above" + (", aligned to the truth" if look(report, "paths.truth") else "")
    return plan_chart(title, _plan_alt(lines, links, unit), [*lines, *links, start, end], unit)


def error_charts(report: Report) -> list[Chart]:
    """Draw position errors over the distance; none where there is no truth."""
    names: tuple[tuple[str, str, Role], ...] = (
        ("without_loops", "without loops", "without"),
        ("estimate", "estimate", "estimate"),
    )
    charts = []
    for key, title in (
        ("error_m", "Position error over the distance, after Sim(3) alignment"),
        ("drift_from_start_m", "Drift from the start over the distance"),
    ):
        lines = [
            Line(label, role, x, y)
            for name, label, role in names
            if len(x := series(report, f"paths.errors.{name}.distance_m"))
            == len(y := series(report, f"paths.errors.{name}.{key}"))
            > 0
        ]
        if lines:
            worst = "; ".join(
                f"{line.label}: at most {say(float(line.y.max()))} m, "
                f"at the end {say(float(line.y[-1]))} m"
                for line in lines
            )
            alt = f"{title}, over {say(float(lines[0].x[-1]))} m. {worst}."
            axes = Axis("distance travelled (m)"), Axis("m", has_zero=True)
            charts.append(line_chart(title, alt, lines, *axes))
    return charts


def _plan_alt(lines: list[Line], links: list[Line], unit: str) -> str:
    x, z = lines[-1].x, lines[-1].y
    drawn = ", ".join(line.label for line in [*lines, *links])
    return (
        f"The path from above: {drawn}. The estimate spans {say(float(np.ptp(x)))} {unit} to the "
        f"right and {say(float(np.ptp(z)))} {unit} forward."
    )


def _links(report: Report) -> list[Line]:
    """Join the two frames of each candidate, where both are on the path."""
    frames = series(report, "paths.estimate.frames")
    x, z = series(report, "paths.estimate.x"), series(report, "paths.estimate.z")
    found = records(report, "closures.records")
    out = []
    names: tuple[tuple[Role, str], ...] = (("rejected", "rejected"), ("accepted", "closed"))
    for role, label in names:
        chosen = [r for r in found if (look(r, "verdict") == "accepted") == (role == "accepted")]
        if chosen and len(frames) == len(x) == len(z):
            ends = np.stack([column(chosen, "frame_a"), column(chosen, "frame_b")], axis=1)
            lines_x, lines_z = (_with_gaps(np.interp(ends, frames, axis)) for axis in (x, z))
            text = f"{label} ({len(chosen)})"
            is_joined = len(chosen) <= _MAX_LINKS or role == "accepted"
            out.append(Line(text, role, lines_x, lines_z, is_marked=True, is_joined=is_joined))
    return out


def _with_gaps(pairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn (N, 2) ends into one line with a gap after each pair."""
    gaps = np.full((len(pairs), 1), np.nan)
    return np.concatenate([pairs, gaps], axis=1).ravel()


def depths(folder: Path) -> Section:
    """Show depth and layers of a few keyframes, then pictures that no other part asks for."""
    names = [
        ("depth", "Image, inverse depth, confidence", "Keyframes of the run: depth, confidence"),
        ("layers", "Image, layers, their scales", "Keyframes of the run: layers and their scales"),
    ]
    others = sorted({path.stem for path in (folder / "pictures").glob("*.png")} - _ELSEWHERE)
    for name in others[:_MAX_OTHERS]:
        words = name.replace("_", " ").capitalize()
        names.append((name, words, f"Picture of the run: {words}"))
    drawn = [find_picture(folder, *each) for each in names]
    pictures = [picture for picture in drawn if picture is not None]
    return Section(
        "depth",
        "Depth" if not others else "Depth and more",
        [Pictures(pictures)] if pictures else [],
    )


_ELSEWHERE = {
    *(name + end for name, _ in _VIEWS for end in ("", _UNFILTERED)),
    *(name for name, _ in _DRAWN),
    *("depth", "layers", "layer_mismatch", "loop_pairs", "scales", "similarity", "stages"),
}
