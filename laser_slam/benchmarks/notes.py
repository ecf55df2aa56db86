"""What to know of numbers, and why some are missing: in few lines."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from laser_slam.benchmarks.grid import NOT_ASKED, PART, Cell, Grid, Row
from laser_slam.benchmarks.measures import remarks
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.table import Table

MOST_LISTED = 10  # members of a group that lacks some: one by one


@dataclass(frozen=True)
class Note:
    """One thing to know.

    Attributes:
        text: itself.
        sequences: that it is about.
        settings: rows that it is about; none: all, or it has nothing to do with them.
    """

    text: str
    sequences: tuple[str, ...]
    settings: tuple[str, ...] = ()

    def line(self, groups: Mapping[str, Sequence[str]]) -> str:
        """Return it as a line, groups of sequences by their names."""
        about = ", ".join(name_groups(self.sequences, groups))
        rows = f" ({', '.join(self.settings)})" if self.settings else ""
        return f"{about}{rows}: {self.text}"


def write_notes(table: Table, grids: Sequence[Grid], outcomes: Sequence[Outcome]) -> list[str]:
    """Return lines on what has no number and what is to know of numbers, each thing once."""
    rows = list(dict.fromkeys(outcome.setting for outcome in outcomes))
    marked = {name for _, _, cell in _cells(grids) for name in cell.parts}
    notes = [
        *_join((one.reason, one.sequence, one.setting) for one in outcomes if one.reason),
        *_join((_of_part(one, marked), one.sequence, "") for one in outcomes if one.part),
        *_join(
            (remark, one.sequence, one.setting)
            for one in outcomes
            if not one.reason
            for remark in remarks(one.scores)
        ),
        *_by_measure(grids, {(one.setting, one.sequence) for one in outcomes if one.reason}),
    ]
    return [_shorten(note, rows).line(table.groups) for note in notes]


def _of_part(one: Outcome, marked: Collection[str]) -> str:
    """Say of which part the numbers of a sequence are, and where they stand if it is in no cell."""
    text = f"{PART}{one.part}"
    is_unseen = one.scores and one.sequence not in marked
    return f"{text}; in no mean, its numbers are in the CSV" if is_unseen else f"*: {text}"


def _join(found: Iterable[tuple[str, str, str]]) -> Iterator[Note]:
    """Give equal texts once; what is so of the same sequences is one note for all its rows."""
    texts: dict[str, dict[str, dict[str, None]]] = {}
    for text, sequence, setting in found:
        texts.setdefault(text, {}).setdefault(setting, {})[sequence] = None
    for text, by_setting in texts.items():
        lines: dict[tuple[str, ...], list[str]] = {}
        for setting, sequences in by_setting.items():
            lines.setdefault(tuple(sequences), []).append(setting)
        for names, settings in lines.items():
            yield Note(text, names, tuple(filter(None, settings)))


def _by_measure(grids: Sequence[Grid], failed: Collection[tuple[str, str]]) -> Iterator[Note]:
    """Give what was run and lacks a number; columns that lack it for one reason together."""
    whats: dict[tuple[str, str, str], dict[str, None]] = {}
    for row, what, cell in _cells(grids):
        for sequence, why in cell.reasons.items():
            if (row.setting, sequence) not in failed and not why.startswith(PART):
                whats.setdefault((why, sequence, row.setting), {})[what] = None
    yield from _join(
        (why if why == NOT_ASKED else f"{' and '.join(found)}: {why}", sequence, setting)
        for (why, sequence, setting), found in whats.items()
    )


def _cells(grids: Sequence[Grid]) -> Iterator[tuple[Row, str, Cell]]:
    """Give what was run, with the name of what is measured."""
    for grid in grids:
        is_one = len({column.measure for column in grid.columns}) == 1
        for row in (row for row in grid.rows if row.source is None):
            for column, cell in zip(grid.columns, row.cells, strict=True):
                yield row, grid.title if is_one else column.name, cell


def _shorten(note: Note, rows: Sequence[str]) -> Note:
    """Leave out the rows where all are meant."""
    is_all = set(note.settings) == set(rows)
    return Note(note.text, note.sequences) if is_all else note


def name_groups(sequences: Sequence[str], groups: Mapping[str, Sequence[str]]) -> list[str]:
    """Name groups instead of their members: whole ones, then large ones that lack a few."""
    left, named = list(sequences), []
    sizes = sorted(groups.items(), key=lambda item: -len(item[1]))
    for is_whole in (True, False):
        for name, members in sizes:
            absent = [member for member in members if member not in left]
            num = len(members) - len(absent)
            if num > 1 and (not absent if is_whole else num > MOST_LISTED > len(absent)):
                but = f" of {len(members)}, not {', '.join(absent)}" if absent else ""
                named.append(f"{name} ({num}{but})")
                left = [sequence for sequence in left if sequence not in members]
    return named + left
