"""Filled tables as Markdown for a page, and as CSV for other programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

from laser_slam.benchmarks.grid import Cell, Grid
from laser_slam.benchmarks.notes import write_notes
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.sources import Sources
from laser_slam.benchmarks.table import Column, Table

OURS = "this run"
NO_NUMBER = "-"
CSV_HEADER = (
    "table block method backbone over column measure value num num_wanted source notes".split()
)


def as_markdown(table: Table, grids: Sequence[Grid], outcomes: Sequence[Outcome]) -> str:
    """Write the blocks of a table, their sources, and what to know of missing numbers."""
    sources = Sources(grids)
    parts = []
    for grid in grids:
        header = [grid.label, *(grid.header(column) for column in grid.columns)]
        lines = [
            [_bold(sources.name(row), is_bold=not row.source), *map(_cell, row.cells)]
            for row in grid.rows
        ]
        rule = ["---", *["---:"] * len(grid.columns)]
        rows = [[_escape(name) for name in header], rule, *lines]
        text = "\n".join("| " + " | ".join(row) + " |" for row in rows)
        parts.append(f"### {grid.heading}\n\n{text}")
    if sources.lines():
        parts.append("  \n".join(_escape(line) for line in sources.lines()))
    notes = write_notes(table, grids, outcomes)
    if notes:
        parts.append("Notes:\n\n" + "\n".join(f"- {_escape(note)}" for note in notes))
    return "\n\n".join(parts) + "\n"


def as_csv(name: str, grids: Sequence[Grid]) -> str:
    """Write one line for each number, with what is to know of it.

    After a mean comes each of its sequences that has a number, and no column for itself.
    """
    out = io.StringIO()
    lines = csv.writer(out, lineterminator="\n")
    lines.writerow(CSV_HEADER)
    for grid in grids:
        for row in grid.rows:
            place = [name, grid.title, row.setting or row.name, row.backbone]
            for column, cell in zip(grid.columns, row.cells, strict=True):
                counts = ["", ""] if row.source else [cell.num, cell.num_wanted]
                what = [column.name, column.measure, _value(cell), *counts]
                over = row.sequence or column.over
                lines.writerow([*place, over, *what, row.source or OURS, _told(cell)])
                for sequence, value in _single(grid, column, cell):
                    what = [column.name, column.measure, value, 1, 1]
                    why = cell.reasons.get(sequence, "")
                    lines.writerow([*place, sequence, *what, OURS, why])
    return out.getvalue()


def _single(grid: Grid, column: Column, cell: Cell) -> Iterator[tuple[str, float]]:
    """Give the sequences of a mean that have a number of their own nowhere else."""
    shown = {other.over for other in grid.columns if other.measure == column.measure}
    if cell.num_wanted > 1:
        yield from ((name, value) for name, value in cell.each.items() if name not in shown)


def _value(cell: Cell) -> float | str:
    return "" if cell.value is None else cell.value


def _told(cell: Cell) -> str:
    return "; ".join(f"{name}: {why}" for name, why in {**cell.parts, **cell.reasons}.items())


def _cell(cell: Cell) -> str:
    return _bold(cell.text, is_bold=cell.is_best)


def _bold(text: str, *, is_bold: bool) -> str:
    return f"**{_escape(text)}**" if is_bold else _escape(text)


def _escape(text: str) -> str:
    """Keep a text from being taken for Markdown."""
    plain = text.replace("|", "\\|").replace("*", "\\*").replace("<", "\\<")
    return " ".join(plain.split()) or NO_NUMBER
