"""Filled tables for the terminal, for a page and for other programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterator, Sequence

from rich.console import Console
from rich.table import Table as Drawn
from rich.text import Text

from laser_slam.benchmarks.grid import NOT_ASKED, PART, Grid
from laser_slam.benchmarks.runner import Outcome

OURS = "this run"
NO_NUMBER = "-"
CSV_HEADER = "table block method column measure value num num_wanted source notes".split()


def print_grids(grids: Sequence[Grid], outcomes: Sequence[Outcome], console: Console) -> None:
    """Print the blocks of a table, rows that were run first, and why numbers are missing."""
    for grid in grids:
        drawn = Drawn(title=grid.title, title_justify="left", show_edge=False)
        drawn.add_column("method", no_wrap=True)
        for column in grid.columns:
            drawn.add_column(column.name, justify="right", overflow="fold")
        if any(row.source for row in grid.rows):
            drawn.add_column("source", style="dim")
        num_ours = sum(row.source is None for row in grid.rows)
        for i, row in enumerate(grid.rows):
            texts = [Text(cell.text) for cell in row.cells]
            source = [Text(row.source or OURS)] if num_ours < len(grid.rows) else []
            name = Text(row.name, style="" if row.source else "bold")
            drawn.add_row(name, *texts, *source, end_section=i == num_ours - 1)
        console.print(drawn)
        console.print()
    missing = list(list_missing(grids, outcomes))
    if missing:
        drawn = Drawn(
            "method",
            "sequences",
            "what to know, or why there is no number",
            title="Notes",
            show_edge=False,
        )
        for line in missing:
            drawn.add_row(*(Text(part) for part in line))
        console.print(drawn)


def as_markdown(grids: Sequence[Grid], outcomes: Sequence[Outcome]) -> str:
    """Write the blocks of a table, and what to know of missing ones, as Markdown."""
    parts = []
    for grid in grids:
        header = ["method", *(column.name for column in grid.columns), "source"]
        rows = [
            [
                row.name if row.source else f"**{row.name}**",
                *(cell.text for cell in row.cells),
                row.source or OURS,
            ]
            for row in grid.rows
        ]
        parts.append(f"{grid.title}\n\n{_markdown_table(header, rows)}")
    missing = [list(line) for line in list_missing(grids, outcomes)]
    if missing:
        table = _markdown_table(
            ["method", "sequences", "what to know, or why there is no number"], missing
        )
        parts.append(f"Notes:\n\n{table}")
    return "\n\n".join(parts) + "\n"


def as_csv(name: str, grids: Sequence[Grid]) -> str:
    """Write one line for each number, with what is to know of it."""
    out = io.StringIO()
    lines = csv.writer(out, lineterminator="\n")
    lines.writerow(CSV_HEADER)
    for grid in grids:
        for row in grid.rows:
            for column, cell in zip(grid.columns, row.cells, strict=True):
                value = "" if cell.value is None else cell.value
                told = {**cell.parts, **cell.reasons}
                notes = "; ".join(f"{name}: {why}" for name, why in told.items())
                place = [name, grid.title, row.name, column.name, column.measure]
                counts = ["", ""] if row.source else [cell.num, cell.num_wanted]
                lines.writerow([*place, value, *counts, row.source or OURS, notes])
    return out.getvalue()


def list_missing(
    grids: Sequence[Grid], outcomes: Sequence[Outcome]
) -> Iterator[tuple[str, str, str]]:
    """Give method, sequences and reason of what has no number, equal reasons in one line."""
    yield from _by_reason(outcomes)
    parts = {(one.sequence, one.part): None for one in outcomes if one.part and not one.reason}
    for sequence, part in parts:
        yield "*", sequence, f"{PART}{part}"
    yield from _by_measure(grids, {(one.setting, one.sequence) for one in outcomes if one.reason})


def _by_measure(
    grids: Sequence[Grid], failed: Collection[tuple[str, str]]
) -> Iterator[tuple[str, str, str]]:
    """Give what was run and lacks a number, rows that lack the same of the same in one line."""
    found: dict[tuple[str, str], dict[str, None]] = {}
    for grid in grids:
        for row in (row for row in grid.rows if row.source is None):
            for column, cell in zip(grid.columns, row.cells, strict=True):
                for sequence, why in cell.reasons.items():
                    if (row.setting, sequence) not in failed and why and not why.startswith(PART):
                        what = why if why == NOT_ASKED else f"{column.measure}: {why}"
                        found.setdefault((row.setting, what), {})[sequence] = None
    lines: dict[tuple[str, str], list[str]] = {}
    for (name, why), sequences in found.items():
        lines.setdefault((", ".join(sequences), why), []).append(name)
    for (names, why), rows in lines.items():
        yield ", ".join(rows), names, why


def _by_reason(outcomes: Sequence[Outcome]) -> Iterator[tuple[str, str, str]]:
    groups: dict[str, dict[str, dict[str, None]]] = {}
    for outcome in outcomes:
        if outcome.reason is not None:
            sequences = groups.setdefault(outcome.reason, {})
            sequences.setdefault(outcome.sequence, {})[outcome.setting] = None
    for reason, sequences in groups.items():
        methods = dict.fromkeys(name for names in sequences.values() for name in names)
        yield ", ".join(methods), ", ".join(sequences), reason


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(_escape, line)) + " |" for line in lines)


def _escape(text: str) -> str:
    """Keep a text from being taken for Markdown; names in bold stay so."""
    plain = text.replace("|", "\\|")
    if not plain.startswith("**"):
        plain = plain.replace("*", "\\*")
    return " ".join(plain.split()) or NO_NUMBER
