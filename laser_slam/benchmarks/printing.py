"""Filled tables for the terminal, in as many pieces as its width asks for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.box import HORIZONTALS
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as Drawn
from rich.text import Text

from laser_slam.benchmarks.grid import Cell, Grid
from laser_slam.benchmarks.notes import write_notes
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.sources import Sources
from laser_slam.benchmarks.table import Table

_BESIDE = 2  # characters between columns
_BEST = "bold green"


def print_grids(
    table: Table, grids: Sequence[Grid], outcomes: Sequence[Outcome], console: Console
) -> None:
    """Print the blocks of a table, rows that were run first, their sources, and what to know."""
    sources = Sources(grids)
    for grid in grids:
        names = [Text(sources.name(row), style="" if row.source else "bold") for row in grid.rows]
        for piece in _pieces(grid, names, console.width):
            continued = " (continued)" if piece.start else ""
            console.print(Text(grid.heading + continued, style="bold"))
            console.print(_draw(grid, names, piece))
            console.print()
    for line in sources.lines():
        console.print(Text(line, style="dim"))
    notes = write_notes(table, grids, outcomes)
    if notes:
        console.print(Text("Notes", style="bold"))
    for note in notes:
        console.print(Padding(Text(f"- {note}"), (0, 0, 0, 1), expand=False))


def _draw(grid: Grid, names: Sequence[Text], piece: range) -> Drawn:
    """Draw some of a block's columns."""
    drawn = Drawn(show_edge=False, box=HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False)
    drawn.add_column(grid.label, no_wrap=True)
    for place in piece:
        drawn.add_column(grid.header(grid.columns[place]), justify="right", no_wrap=True)
    num_ours = sum(row.source is None for row in grid.rows)
    for index, (name, row) in enumerate(zip(names, grid.rows, strict=True)):
        cells = [_styled(row.cells[place]) for place in piece]
        drawn.add_row(name, *cells, end_section=index == num_ours - 1)
    return drawn


def _styled(cell: Cell) -> Text:
    return Text(cell.text, style=_BEST if cell.is_best else "")


def _pieces(grid: Grid, names: Sequence[Text], width: int) -> Iterator[range]:
    """Give the columns that fit beside one another, at least one at a time."""
    label = max(len(text) for text in [grid.label, *map(str, names)]) + _BESIDE
    first, taken = 0, label
    for place, column in enumerate(grid.columns):
        texts = [grid.header(column), *(row.cells[place].text for row in grid.rows)]
        needed = max(map(len, texts)) + _BESIDE
        if place > first and taken + needed > width:
            yield range(first, place)
            first, taken = place, label
        taken += needed
    yield range(first, len(grid.columns))
