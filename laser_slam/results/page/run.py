"""The page's account of the run itself: settings, time, calibration, counters, files."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pydantic import BaseModel

from laser_slam import __version__
from laser_slam.config import Config
from laser_slam.report.html import Bar, Bars, Block, Fold, Notes, Section, Table, Text
from laser_slam.results.page.reading import (
    Report,
    count,
    file_size,
    flatten,
    look,
    number,
    plain,
    say,
)

_MAX_WARNINGS = 300
_MAX_GROUPS = 12  # at the top of the page
_NUMBER = re.compile(r"\d+(\.\d+)?")
_NO_COUNTERS = {
    *("sequence", "trajectory", "depth", "depth_without_layers", "paths"),
    *("warnings", "seconds", "versions", "settings", "finished"),
}


def facts(report: Report) -> list[str]:
    """Say in a few words each what was run."""
    read, keyframes = number(report, "frames.read"), number(report, "frames.keyframes")
    unreadable = number(report, "frames.unreadable")
    width, height = number(report, "sequence.width"), number(report, "sequence.height")
    backbone = look(report, "settings.backbone.name")
    found = [
        f"{count(read)} frames" if read is not None else "",
        f"{count(keyframes)} keyframes" if keyframes is not None else "",
        f"{count(unreadable)} unreadable" if unreadable else "",
        f"{width:.0f} × {height:.0f}" if width and height else "",
        f"{count(number(report, 'windows.num'))} windows" if look(report, "windows") else "",
        f"backbone {backbone}" if backbone else "",
        f"laser-slam {look(report, 'versions.laser-slam') or '(version unknown)'}",
        str(look(report, "finished") or "").replace("T", " ")[:16],
    ]
    return [text for text in found if text]


def group_warnings(report: Report) -> list[str]:
    """Say warnings that differ in their numbers only once, with how many there are.

    >>> warnings = ["frame 4 cannot be read", "frame 5 cannot be read", "the map is empty"]
    >>> group_warnings({"warnings": warnings})
    ['frame 4 cannot be read (and 1 more like it)', 'the map is empty']
    """
    alike: defaultdict[str, list[str]] = defaultdict(list)
    for warning in _warnings(report):
        alike[_NUMBER.sub("N", warning)].append(warning)
    groups = [
        each[0] + (f" (and {count(len(each) - 1)} more like it)" if len(each) > 1 else "")
        for each in alike.values()
    ]
    more = len(groups) - _MAX_GROUPS
    return groups[:_MAX_GROUPS] + (
        [f"{count(more)} more below, in the details"] if more > 0 else []
    )


def _warnings(report: Report) -> list[str]:
    return [str(warning) for warning in look(report, "warnings") or []]


def time_by_stage(report: Report) -> Section:
    """Show where the time went, longest first."""
    found = look(report, "seconds.wall") or {}
    wall = {stage: s for stage in found if (s := number(found, stage)) is not None}
    total = sum(wall.values())
    stages = sorted(wall, key=lambda stage: -wall[stage])
    bars = [
        Bar(
            stage,
            wall[stage] / max(wall[stages[0]], 1e-9),
            [
                f"{wall[stage]:,.1f}",
                f"{100 * wall[stage] / max(total, 1e-9):.1f} %",
                f"{number(report, f'seconds.cpu.{stage}') or 0:,.1f}",
            ],
        )
        for stage in stages
    ]
    if not bars:
        return Section("time", "Time", [])
    cpu = say(number(report, "seconds.cpu_in_all"))
    caption = f"{say(total)} s in all" + (f", {cpu} s of processor time" if cpu else "")
    head = ["stage", "wall time", "s", "share", "processor s"]
    return Section("time", "Time", [Bars(caption, head, bars)])


def settings(report: Report) -> Section:
    """Show the settings that differ from the defaults, then all of them, then versions."""
    given = look(report, "settings")
    if not given:
        return Section("settings", "Settings", [])
    defaults = dict(flatten(Config().model_dump(mode="json")))
    words = dict(_descriptions(Config))
    rows = [
        [name, plain(value), _default(defaults, name), words.get(name, "")]
        for name, value in flatten(given)
    ]
    changed = [row for row in rows if row[1] != row[2]]
    head = ["setting", "value", "default", "meaning"]
    caption = f"Settings that differ from the defaults of laser-slam {__version__}"
    blocks: list[Block] = []
    if changed:
        blocks.append(Table(caption, head, changed, frozenset({1, 2, 3})))
    else:
        blocks.append(Text("All settings are the defaults."))
    every = Table("All settings", head, rows, frozenset({1, 2, 3}))
    blocks.append(Fold(f"All {len(rows)} settings", [every]))
    return Section("settings", "Settings", blocks)


def _default(defaults: dict[str, Any], name: str) -> str:
    return plain(defaults[name]) if name in defaults else ""


def _descriptions(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _descriptions(field.annotation, f"{prefix}{key}.")
        else:
            yield prefix + key, field.description or ""


def details(report: Report, folder: Path) -> Section:
    """Show calibration, counters, all warnings, versions and the files beside the page."""
    blocks = [_calibration(report), _counters(report), *_all_warnings(report)]
    versions = [[name, plain(value)] for name, value in flatten(look(report, "versions") or {})]
    if versions:
        table = Table(
            "Of laser-slam and what it used", ["package", "version"], versions, frozenset({1})
        )
        blocks.append(Fold("Versions", [table]))
    return Section("details", "Details", [*blocks, _files(folder)])


def _calibration(report: Report) -> Block:
    rows = [
        [text, *(say(number(report, f"sequence.{key}.{name}"), 5) for name in _FOUR)]
        for key, text in (("intrinsics", "as used"), ("intrinsics_given", "as given"))
        if look(report, f"sequence.{key}")
    ]
    distortion = look(report, "sequence.distortion")
    text = (
        f"Calibration: {plain(look(report, 'sequence.calibration'))}. "
        f"Source: {plain(look(report, 'sequence.intrinsics_source'))}. "
        f"Distortion: {plain(distortion)}."
    )
    table = Table("Pinhole camera, pixels of the input", ["intrinsics", *_FOUR], rows)
    return Fold("Calibration", [Text(text), *([table] if rows else [])])


_FOUR = ("fx", "fy", "cx", "cy")


def _counters(report: Report) -> Block:
    """List every number that is no score, no series and no setting; new parts of a report too."""
    rows = [
        [name, _mark_thousands(value)]
        for part in report
        if part not in _NO_COUNTERS
        for name, value in flatten({part: _without_series(report[part])})
    ]
    table = Table("Names as in report.json; null: unknown", ["counter", "value"], rows)
    return Fold("Counters", [table])


def _mark_thousands(value: Any) -> str:
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    return count(value) if is_whole else plain(value)


def _without_series(part: Any) -> Any:
    """Keep what is a single value, and count the rest."""
    if not isinstance(part, Mapping):
        return f"{len(part)} entries" if isinstance(part, list) else part
    return {
        key if not isinstance(value, Mapping | list) else f"{key} (entries)": (
            len(value) if isinstance(value, Mapping | list) else value
        )
        for key, value in part.items()
    }


def _all_warnings(report: Report) -> list[Block]:
    """List what the top of the page has only summed up."""
    warnings = _warnings(report)
    if group_warnings(report) == warnings:
        return []
    shown = warnings[:_MAX_WARNINGS]
    more = len(warnings) - len(shown)
    rest = [Text(f"{count(more)} more are in run.log.")] if more else []
    return [Fold(f"All {count(len(warnings))} warnings", [Notes(shown), *rest])]


def _files(folder: Path) -> Block:
    """List the run's folder; folders within it in one row each."""
    rows: list[list[str]] = []
    links: dict[int, str] = {}
    entries = sorted(folder.iterdir(), key=lambda path: (path.is_dir(), path.name))
    for path in entries:
        if path.name.startswith(".") or path.name == "report.html":
            continue
        if path.is_dir():
            inner = [each for each in path.rglob("*") if each.is_file()]
            size = sum(each.stat().st_size for each in inner)
            files = f"{count(len(inner))} file{'s' * (len(inner) != 1)}"
            meaning = _MEANINGS.get(f"{path.name}/")
            row = [f"{path.name}/", file_size(size), f"{files}: {meaning}" if meaning else files]
        else:
            row = [path.name, file_size(path.stat().st_size), _MEANINGS.get(path.name, "")]
        links[len(rows)] = quote(row[0])
        rows.append(row)
    table = Table(
        "Links work where the page lies in the run's folder", _FILES, rows, frozenset({2}), links
    )
    return Fold("Files", [table])


_FILES = ("file", "size", "holds")
_MEANINGS = {
    "report.json": "all numbers of this page, for machines",
    "config.yaml": "all settings",
    "sequence.yaml": "what tells the input from others",
    "calibration.yaml": "the camera, lens included",
    "map.ply": "the map, in world units",
    "trajectory_kitti.txt": "a pose for every frame, KITTI's format",
    "trajectory_tum.txt": "a pose for every frame, TUM's format",
    "trajectory_without_loops_tum.txt": "the same by the registrations alone",
    "truth_tum.txt": "true poses, metres",
    "closures.json": "what became of each candidate of a loop",
    "graph.g2o": "the pose graph",
    "run.log": "what the run said",
    "run.rrd": "the recording that rerun shows",
    "keyframes.npz": "where the keyframes lie, and which windows own them",
    "frames.npz": "times of the frames, and which of them cannot be read",
    "images.json": "the files of the input, and their camera",
    "predictions.yaml": "what the windows' predictions were made with",
    "layers/": "depth layers of each window, and their scales",
    "pictures/": "the pictures of this page",
    "tiles/": "the map in parts, as exports and viewers read it",
    "windows/": "what the backbone saw in each window",
}
