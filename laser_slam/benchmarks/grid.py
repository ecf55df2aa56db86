"""Outcomes as rows and columns, beside what others have published."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

from laser_slam.benchmarks.measures import (
    MEASURES,
    Measure,
    Scores,
    look_up,
    weight,
    why_missing,
)
from laser_slam.benchmarks.runner import Outcome
from laser_slam.benchmarks.table import Block, Column, Table
from laser_slam.evaluation import SequenceScores, failed_sequence, mean_score

NOT_ASKED = "not asked for"
PART = "only a part is there: "


@dataclass(frozen=True)
class Cell:
    """One number, or why there is none.

    Attributes:
        value: with the measure's factor; a word; None: there is none.
        num: sequences that it is the mean over.
        num_wanted: sequences that it should be the mean over.
        digits: after the point.
        reasons: why sequences are not in it, by name.
        parts: which part of a sequence is in it, by name; of all others it is the whole.
    """

    value: float | str | None
    num: int = 1
    num_wanted: int = 1
    digits: int = 2
    reasons: dict[str, str] = field(default_factory=dict)
    parts: dict[str, str] = field(default_factory=dict)

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


@dataclass(frozen=True)
class Row:
    """One line: a setting that was run, or what others have published.

    Attributes:
        source: who has published it; None: it was run.
        setting: that was run.
    """

    name: str
    cells: tuple[Cell, ...]
    source: str | None = None
    setting: str = ""


@dataclass(frozen=True)
class Grid:
    """One block of a table, filled."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]


def fill_grids(table: Table, outcomes: Sequence[Outcome]) -> list[Grid]:
    """Put outcomes into the columns of a table.

    A mean is over the sequences that have the number, and says over how many; each of the others
    is in the cell's reasons. So is one of which only a part is there: no mean has it in it.
    Blocks of which no sequence was asked for are left out.
    """
    names = list(dict.fromkeys(outcome.setting for outcome in outcomes))
    by_place = {(outcome.setting, outcome.sequence): outcome for outcome in outcomes}
    asked = {outcome.sequence for outcome in outcomes}
    grids = []
    for block in table.blocks:
        if not asked & {name for column in block.all_columns for name in table.members(column)}:
            continue
        rows = []
        for label, name, columns in _lines(block, names, asked):
            cells = []
            for column in columns:
                members = table.members(column)
                found = [by_place.get((name, sequence)) for sequence in members]
                cells.append(_cell(column, members, found))
            rows.append(Row(label, tuple(cells), setting=name))
        grids.append(Grid(block.title, block.columns, (*rows, *_published(block))))
    return grids


def _lines(
    block: Block, names: Sequence[str], asked: Collection[str]
) -> Iterator[tuple[str, str, tuple[Column, ...]]]:
    """Give label, setting and columns of each line that was run."""
    if not block.each:
        yield from ((name, name, block.columns) for name in names)
    for sequence in (sequence for sequence in block.each if sequence in asked):
        for name in names:
            label = sequence if len(names) == 1 else f"{sequence}, {name}"
            yield label, name, block.columns_of(sequence)


def _cell(column: Column, members: Sequence[str], outcomes: Sequence[Outcome | None]) -> Cell:
    measure = MEASURES[column.measure]
    rows, reasons, parts = [], {}, {}
    for name, outcome in zip(members, outcomes, strict=True):
        scores: Scores = {} if outcome is None else outcome.scores
        value = look_up(scores, measure)
        part = None if outcome is None else outcome.part
        if value is None or (part is not None and len(members) > 1):
            reasons[name] = _why(outcome, measure)
            rows.append(failed_sequence(name, reasons[name]))
        else:
            found = {column.measure: value * measure.factor}
            rows.append(SequenceScores(name, found, weight(scores, measure)))
            if part is not None:
                parts[name] = part
    mean = mean_score(rows, column.measure, is_weighted=True)
    return Cell(mean.value, mean.num, mean.num_sequences, measure.digits, reasons, parts)


def _why(outcome: Outcome | None, measure: Measure) -> str:
    if outcome is None:
        return NOT_ASKED
    if look_up(outcome.scores, measure) is not None:
        return f"{PART}{outcome.part}"
    return outcome.reason or why_missing(outcome.scores, measure)


def _published(block: Block) -> list[Row]:
    return [
        Row(row.method, tuple(Cell(_as_printed(value)) for value in row.values), row.source)
        for row in block.published
    ]


def _as_printed(value: float | str | None) -> str | None:
    """Write a published number without digits that its source did not give."""
    return value if value is None or isinstance(value, str) else f"{value:g}"
