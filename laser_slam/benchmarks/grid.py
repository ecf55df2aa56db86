"""Outcomes as rows and columns, beside what others have published."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import mul

from laser_slam.benchmarks.measures import (
    MEASURES,
    Better,
    Measure,
    Scores,
    look_up,
    weight,
    why_missing,
)
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.table import Block, Column, Table

NOT_ASKED = "not asked for"
PART = "only a part is there: "


@dataclass(frozen=True)
class Cell:
    """One number, or why there is none.

    Attributes:
        value: with the measure's factor; a word, or a number as it was printed; None: none.
        num: sequences that it is the mean over.
        num_wanted: sequences that it should be the mean over.
        digits: after the point.
        reasons: why sequences are not in it, by name.
        parts: which part of a sequence is in it, by name; of all others it is the whole.
        each: the numbers of the sequences that have one, by name, whether they are in it or not.
        is_best: no complete number of the column is better.
    """

    value: float | str | None
    num: int = 1
    num_wanted: int = 1
    digits: int = 2
    reasons: dict[str, str] = field(default_factory=dict)
    parts: dict[str, str] = field(default_factory=dict)
    each: dict[str, float] = field(default_factory=dict)
    is_best: bool = False

    @property
    def text(self) -> str:
        """Return the number, and over how many of how many if it is not over all; *: over parts.

        >>> Cell(1.234, 2, 3, parts={"03": "300 of 801 frames"}).text
        '1.23* (2 of 3)'
        """
        if self.value is None:
            return "-"
        if isinstance(self.value, str):
            return self.value
        of = "" if self.num == self.num_wanted else f" ({self.num} of {self.num_wanted})"
        return f"{self.value:.{self.digits}f}{'*' if self.parts else ''}{of}"

    @property
    def complete(self) -> float | None:
        """Return the number as it is shown; None: none, or one over a part of what it should be."""
        if self.parts or self.num != self.num_wanted:
            return None
        try:
            return float(self.text)
        except ValueError:
            return None


@dataclass(frozen=True)
class Row:
    """One line: a setting that was run, or what others have published.

    Attributes:
        name: in the line.
        cells: one for each column.
        source: who has published it; None: it was run.
        setting: that was run.
        sequence: that the line is of alone; None: the columns say of which they are.
        backbone: that predicted; several: with commas.
    """

    name: str
    cells: tuple[Cell, ...]
    source: str | None = None
    setting: str = ""
    sequence: str | None = None
    backbone: str = ""


@dataclass(frozen=True)
class Grid:
    """One block of a table, filled.

    Attributes:
        title: of the block.
        columns: those of which something was asked.
        rows: what was run, then what others have published.
        label: what the names of the lines are.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    label: str = "method"

    @property
    def heading(self) -> str:
        """Return the title, and which numbers are better where that is one for all columns."""
        words = {_better(column) for column in self.columns}
        word = words.pop() if len(words) == 1 else None
        return f"{self.title}; {word} is better" if word else self.title

    def header(self, column: Column) -> str:
        """Return a column's name, and which numbers are better where that differs."""
        if len({_better(other) for other in self.columns}) == 1:
            return column.name
        return column.name + {"lower": " ↓", "higher": " ↑", None: ""}[_better(column)]


def _better(column: Column) -> Better | None:
    return MEASURES[column.measure].better


def fill_grids(table: Table, outcomes: Sequence[Outcome]) -> list[Grid]:
    """Put outcomes into the columns of a table.

    A mean is over the sequences that have the number, and says over how many; each of the others
    is in the cell's reasons. So is one of which only a part is there: no mean has it in it.
    Blocks and columns of which nothing was asked are left out.
    """
    names = list(dict.fromkeys(outcome.setting for outcome in outcomes))
    asked = {outcome.sequence for outcome in outcomes}
    found = _Found(table, {(one.setting, one.sequence): one for one in outcomes})
    grids = []
    for block in table.blocks:
        if not asked & {name for column in block.all_columns for name in table.members(column)}:
            continue
        places = _places_asked(table, block, asked)
        ours = [
            replace(found.row(name, [columns[i] for i in places]), name=label, sequence=sequence)
            for label, sequence, name, columns in _lines(block, names, asked)
        ]
        columns = tuple(block.columns[i] for i in places)
        rows = _mark_best(columns, [*ours, *_published(block, places)])
        label = ("sequence, method" if len(names) > 1 else "sequence") if block.each else "method"
        grids.append(Grid(block.title, columns, tuple(rows), label))
    return grids


def _places_asked(table: Table, block: Block, asked: Collection[str]) -> list[int]:
    """Return which columns are of something that was asked for.

    A mean of which only one sequence was asked for goes where that one has a column for itself.
    """
    if block.each:
        return list(range(len(block.columns)))
    alone = {(column.measure, table.members(column)) for column in block.columns}
    places = []
    for place, column in enumerate(block.columns):
        members = table.members(column)
        wanted = tuple(name for name in members if name in asked)
        if wanted and (wanted == members or (column.measure, wanted) not in alone):
            places.append(place)
    return places


def _lines(
    block: Block, names: Sequence[str], asked: Collection[str]
) -> Iterator[tuple[str, str | None, str, tuple[Column, ...]]]:
    """Give label, sequence, setting and columns of each line that was run."""
    if not block.each:
        yield from ((name, None, name, block.columns) for name in names)
    for sequence in (sequence for sequence in block.each if sequence in asked):
        for name in names:
            label = sequence if len(names) == 1 else f"{sequence}, {name}"
            yield label, sequence, name, block.columns_of(sequence)


@dataclass(frozen=True)
class _Found:
    """Outcomes by row and sequence."""

    table: Table
    by_place: dict[tuple[str, str], Outcome]

    def row(self, setting: str, columns: Sequence[Column]) -> Row:
        cells: list[Cell] = []
        backbones: dict[str, None] = {}
        for column in columns:
            members = self.table.members(column)
            outcomes = [self.by_place.get((setting, sequence)) for sequence in members]
            backbones.update({one.backbone: None for one in outcomes if one and one.backbone})
            cells.append(_cell(column, members, outcomes))
        return Row(setting, tuple(cells), setting=setting, backbone=", ".join(backbones))


def _cell(column: Column, members: Sequence[str], outcomes: Sequence[Outcome | None]) -> Cell:
    measure = MEASURES[column.measure]
    values, weights, reasons, parts, each = [], [], {}, {}, {}
    for name, outcome in zip(members, outcomes, strict=True):
        scores: Scores = {} if outcome is None else outcome.scores
        value = look_up(scores, measure)
        part = None if outcome is None else outcome.part
        if value is not None:
            each[name] = value * measure.factor
        if value is None or (part is not None and len(members) > 1):
            reasons[name] = _why(outcome, measure)
            continue
        values.append(each[name])
        weights.append(weight(scores, measure))
        if part is not None:
            parts[name] = part
    mean = sum(map(mul, weights, values)) / sum(weights) if values else None
    return Cell(mean, len(values), len(members), measure.digits, reasons, parts, each)


def _why(outcome: Outcome | None, measure: Measure) -> str:
    if outcome is None:
        return NOT_ASKED
    if look_up(outcome.scores, measure) is not None:
        return f"{PART}{outcome.part}"
    return outcome.reason or why_missing(outcome.scores, measure)


def _published(block: Block, places: Sequence[int]) -> list[Row]:
    """Return the rows of others that have something in these columns."""
    rows = []
    for row in block.published:
        values = [row.values[place] for place in places]
        if any(value is not None for value in values):
            rows.append(Row(row.method, tuple(Cell(value) for value in values), row.source))
    return rows


def _mark_best(columns: Sequence[Column], rows: Sequence[Row]) -> list[Row]:
    """Mark the best numbers of each column, where several rows have one of the same sequences."""
    marked = [list(row.cells) for row in rows]
    for place, better in enumerate(map(_better, columns)):
        groups: dict[str | None, dict[int, float]] = {}
        for index, row in enumerate(rows):
            number = row.cells[place].complete
            if better and number is not None:
                groups.setdefault(row.sequence, {})[index] = number
        for numbers in groups.values():
            best = (max if better == "higher" else min)(numbers.values())
            for index, number in numbers.items():
                if number == best and len(set(numbers.values())) > 1:
                    marked[index][place] = replace(marked[index][place], is_best=True)
    return [replace(row, cells=tuple(cells)) for row, cells in zip(rows, marked, strict=True)]
