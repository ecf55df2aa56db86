"""What tables there are, and what one of them would run, before it does."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Sized

from laser_slam.benchmarks.notes import name_groups
from laser_slam.benchmarks.row_run import RowRun
from laser_slam.benchmarks.runner import Bench
from laser_slam.benchmarks.settings import Setting
from laser_slam.benchmarks.table import load_table, table_names


def list_tables() -> Iterator[tuple[str, str]]:
    """Give the name of each shipped table, and what it is in a line."""
    for name in table_names():
        table = load_table(name)
        size = f"{_count(table.rows, 'row')}, {_count(table.sequences, 'sequence')}"
        yield name, f"{table.title} ({size})"


def list_rows(settings: Sequence[Setting]) -> Iterator[tuple[str, str]]:
    """Give the name of each row, and the settings in which it differs."""
    for setting in settings:
        yield setting.name, " ".join(setting.assignments) or "no setting of its own"


def list_groups(groups: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str]]:
    """Give the name of each group of rows or sequences, and its members."""
    for name, members in groups.items():
        yield name, ", ".join(members)


def list_sequences(bench: Bench, settings: Sequence[Setting]) -> Iterator[tuple[str, str]]:
    """Give the names of sequences, and whether they are there and were run, equal ones together."""
    runs = bench.runs(settings)
    by_state: dict[str, list[str]] = {}
    for name in bench.sequences():
        state = _state([run for run in runs if run.name == name])
        by_state.setdefault(state, []).append(name)
    for state, names in by_state.items():
        yield ", ".join(name_groups(names, bench.table.groups)), state


def _state(runs: Sequence[RowRun]) -> str:
    num, spec = sum(run.is_finished for run in runs), runs[0].spec
    if num == len(runs):
        return "finished"
    frames, reason = runs[0].place.material.look(spec, runs[0].config)
    if reason is not None:
        return f"no: {reason}"
    is_part = spec.num_frames is not None and frames < spec.num_frames
    of = f" of {spec.num_frames}" if is_part else ""
    state = f"{frames}{of} frames" if frames else "there"
    return f"{state}, {num} of {_count(runs, 'row')} finished" if num else state


def _count(things: Sized, word: str) -> str:
    num = len(things)
    return f"{num} {word}{'' if num == 1 else 's'}"
