"""The page's table of loops."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from laser_slam.report.html import Block, Pair, Pairs, Pictures, Section, Table, Text
from laser_slam.report.html_pictures import Embedded, embed
from laser_slam.results.loop_pictures import thumbnail
from laser_slam.results.page.paths import find_picture
from laser_slam.results.page.reading import (
    Report,
    count,
    look,
    number,
    percent,
    plain,
    records,
    say,
)

_MAX_ROWS = 300
_MAX_PAIRS = 24
_WIDTH_PX, _MAX_BYTES = 320, 14_000  # of a thumbnail
ACCEPTED = "accepted"


def loops(report: Report, folder: Path) -> Section:
    """Show what became of each candidate, accepted ones first, with their images."""
    if look(report, "closures") is None:
        return Section("loops", "Loops", [Text("Loops were not looked for.")])
    found = sorted(_candidates(report, folder), key=lambda row: look(row, "verdict") != ACCEPTED)
    blocks: list[Block] = [Text(_in_words(report, len(found)))]
    pairs = _pairs(found, folder)
    if pairs:
        blocks.append(Pairs(pairs))
    elif sheet := find_picture(folder, "loop_pairs", "Pairs of images", "Images of candidates"):
        blocks.append(Pictures([sheet]))
    if found:
        blocks.append(_table(found))
    title = "Similarity of the keyframes' descriptors"
    alt = f"{title}: each keyframe against each other, loops ringed"
    if similarity := find_picture(folder, "similarity", title, alt):
        blocks.append(Pictures([similarity], "two"))
    return Section("loops", "Loops", blocks)


def _candidates(report: Report, folder: Path) -> list[Report]:
    """Take the records from the report, or from the file of closures beside it."""
    if look(report, "closures.records") is not None:
        return records(report, "closures.records")
    try:
        stored: Any = json.loads((folder / "closures.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return records({"records": stored}, "records")


def _in_words(report: Report, num: int) -> str:
    if not num:
        return "No two places of the run resembled each other enough to be compared."
    accepted = count(number(report, "closures.accepted"))
    text = f"{accepted} of {count(number(report, 'closures.candidates'))} candidates were closed."
    refused = look(report, "closures.refused")
    if isinstance(refused, Mapping) and refused:
        reasons = "; ".join(f"{reason} ({plain(times)})" for reason, times in refused.items())
        text += f" Rejected: {reasons}."
    return text


def _pairs(found: Sequence[Report], folder: Path) -> list[Pair]:
    images: dict[int, Embedded | None] = {}
    pairs: list[Pair] = []
    for row in found:
        frames = number(row, "frame_a"), number(row, "frame_b")
        if len(pairs) == _MAX_PAIRS or frames[0] is None or frames[1] is None:
            continue
        a, b = int(frames[0]), int(frames[1])
        for frame in (a, b):
            if frame not in images:
                path = thumbnail(folder / "pictures", frame)
                images[frame] = embed(path, _WIDTH_PX, _MAX_BYTES)
        first, second = images[a], images[b]
        if first is not None and second is not None:
            pairs.append(_pair(row, (first, second), (a, b)))
    return pairs


def _pair(row: Report, images: tuple[Embedded, Embedded], frames: tuple[int, int]) -> Pair:
    is_accepted = look(row, "verdict") == ACCEPTED
    similarity = f"similarity {say(number(row, 'similarity'), 2)}"
    if not is_accepted:
        similarity += f"; {plain(look(row, 'verdict'))}"
    return Pair(
        images,
        (f"Frame {frames[0]}", f"Frame {frames[1]}"),
        is_accepted,
        f"{'closed' if is_accepted else 'rejected'}: frames {frames[0]} and {frames[1]}",
        similarity,
    )


_HEAD = (
    "frames",
    "windows",
    "verdict",
    "similarity",
    "image matches",
    "with depth",
    "residual",
    "scale",
    "by the chain",
    "heading",
    "overlap",
    "sigmas apart",
)


def _table(found: Sequence[Report]) -> Table:
    shown = found[:_MAX_ROWS]
    caption = f"{len(found)} candidates, closed ones first"
    if len(shown) < len(found):
        caption += f"; {len(shown)} are shown, all are in closures.json"
    rows = [_cells(row) for row in shown]
    is_measured_twice = any(row[-1] for row in rows)  # only then can they be sigmas apart
    used = len(_HEAD) if is_measured_twice else len(_HEAD) - 1
    return Table(caption, _HEAD[:used], [row[:used] for row in rows], frozenset({2}))


def _cells(row: Report) -> list[str]:
    is_accepted = look(row, "verdict") == ACCEPTED
    heading, source = number(row, "heading_deg"), look(row, "source")
    by = f", by {source}" if source else ""
    return [
        f"{plain(look(row, 'frame_a'))} – {plain(look(row, 'frame_b'))}",
        f"{plain(look(row, 'window_a'))} – {plain(look(row, 'window_b'))}",
        f"closed{by}" if is_accepted else f"rejected: {plain(look(row, 'verdict'))}",
        say(number(row, "similarity"), 2),
        count(number(row, "image_inliers")),
        count(number(row, "inliers")),
        percent(number(row, "residual"), 2),
        say(number(row, "scale")),
        say(number(row, "chain_scale")),
        "" if heading is None else f"{heading:.0f}°",
        percent(number(row, "overlap"), 2),
        say(number(row, "disagreement"), 2),
    ]
