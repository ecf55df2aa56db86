"""Every row of a table on every sequence, what is there before what must wait."""

from __future__ import annotations

import difflib
import logging
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from laser_slam.benchmarks.claims import TakenError, claimed
from laser_slam.benchmarks.material import LastOpened
from laser_slam.benchmarks.notes import name_groups
from laser_slam.benchmarks.outcome import NOT_YET, Outcome
from laser_slam.benchmarks.pace import Pace, in_words
from laser_slam.benchmarks.readiness import Readiness, refuse_unknown_names
from laser_slam.benchmarks.row_run import Place, RowRun
from laser_slam.benchmarks.settings import Setting
from laser_slam.bookkeeping import Progress, no_progress
from laser_slam.config import Config, assigned, load_config
from laser_slam.errors import ConfigError

logger = logging.getLogger(__name__)

MOST_NAMED = 15  # sequences and groups in an error
OnOutcomes = Callable[[list[Outcome]], object]


def plain_settings(below: Sequence[str], above: Sequence[str]) -> Config:
    """Resolve the settings of sequence and row over those of the table, with none of a user."""
    return load_config(assignments=above, base=assigned(below))


def keep_nothing(_outcomes: list[Outcome]) -> None:
    """Do nothing with what is known so far."""


@dataclass(frozen=True)
class Bench(Place):
    """A table to run.

    Attributes:
        resolve: layers the user's settings between the ``section.key=value`` of the table, which
            lie below, and those of sequence and row, which lie above.
        only: names of sequences or groups; none: all.
    """

    resolve: Callable[[Sequence[str], Sequence[str]], Config] = plain_settings
    only: tuple[str, ...] = ()

    def sequences(self) -> list[str]:
        """Return the names of the sequences that are run, in the table's order.

        Raises:
            LaserSlamError: one that is asked for is none.
        """
        groups = {**self.table.groups, **{name: (name,) for name in self.table.sequences}}
        unknown = [name for name in self.only if name not in groups]
        if unknown:
            near = difflib.get_close_matches(unknown[0], groups, n=1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            there = ", ".join(list(groups)[:MOST_NAMED])
            more = ", ... (--list shows all)" if len(groups) > MOST_NAMED else ""
            raise ConfigError(
                f"--only {unknown[0]}: no such sequence{hint}; there is {there}{more}"
            )
        wanted = {name for group in self.only for name in groups[group]}
        return [name for name in self.table.sequences if name in wanted or not self.only]

    def runs(self, settings: Sequence[Setting]) -> list[RowRun]:
        """Return all runs in their order: all rows on the first sequence, then the next.

        Raises:
            LaserSlamError: a setting is unknown, or a sequence that is asked for is none.
        """
        runs = [
            RowRun(self, setting, name, self._config(setting, name))
            for name in self.sequences()
            for setting in settings
        ]
        for run in runs:
            refuse_unknown_names(run.config)
        return runs

    def run(
        self,
        settings: Sequence[Setting],
        on_progress: Progress = no_progress,
        on_outcomes: OnOutcomes = keep_nothing,
    ) -> list[Outcome]:
        """Run what has not been run yet, and score it; what fails becomes a reason.

        Args:
            settings: the rows.
            on_progress: called with a stage's name, how much is done and of how much.
            on_outcomes: called after each run with all outcomes, those to come among them.

        Returns:
            Row by row, the sequences in the table's order.

        Raises:
            LaserSlamError: a setting is unknown, or a sequence that is asked for is none.
        """
        runs = self.runs(settings)
        work = _Work(runs)
        work.prepare()
        for is_last in (False, True):  # what another process is at is looked at once more
            for run in work.left():
                on_progress("runs", len(work.done), len(runs))
                if work.do(run, on_progress, is_last=is_last):
                    on_outcomes(work.outcomes(settings))
                self._drop_predictions(work, run.name)
        on_progress("runs", len(runs), len(runs))
        return work.outcomes(settings)

    def _config(self, setting: Setting, name: str) -> Config:
        spec = self.table.sequences[name]
        return self.resolve(self.table.settings, [*spec.settings, *setting.assignments])

    def _drop_predictions(self, work: _Work, name: str) -> None:
        """Remove shared predictions of a sequence of which all rows have their scores."""
        runs = [run for run in work.runs if run.name == name]
        if not (self.is_lean and self.is_shared and all(run.key in work.done for run in runs)):
            return
        if not any(work.done[run.key].reason for run in runs):
            for folder in {run.shared for run in runs}:
                with suppress(TakenError), claimed(folder):  # another process may read it
                    shutil.rmtree(folder, ignore_errors=True)


class _Work:
    """Runs, what became of them, and how long the rest will take."""

    def __init__(self, runs: list[RowRun]) -> None:
        self.runs = runs
        self.done: dict[tuple[str, str], Outcome] = {}
        self._readiness, self._opened = Readiness(), LastOpened()
        self._absent: dict[str, str] = {}
        frames: dict[str, int] = {}
        self._to_do: dict[tuple[str, str], RowRun] = {}
        for run in (run for run in runs if not run.is_finished):
            if run.name not in {*frames, *self._absent}:
                num, reason = run.place.material.look(run.spec, run.config)
                if reason is None:
                    frames[run.name] = num
                else:
                    self._absent[run.name] = reason
            if run.name in frames:
                self._to_do[run.key] = run
        self._pace = Pace({key: frames[run.name] for key, run in self._to_do.items()})

    def prepare(self) -> None:
        """Say what will be done, and find out before the first run what cannot be."""
        num_without = sum(run.name in self._absent and not run.is_finished for run in self.runs)
        num, num_left = len(self.runs), len(self._to_do)
        logger.info(
            "%d runs: %d finished before, %d without data, %d to go",
            num, num - num_without - num_left, num_without, num_left,
        )  # fmt: skip
        for reason in dict.fromkeys(self._absent.values()):
            names = [name for name, why in self._absent.items() if why == reason]
            groups = self.runs[0].place.table.groups
            logger.warning("%s: %s", ", ".join(name_groups(names, groups)), reason)
        self._readiness.check(run.config for run in self._to_do.values())

    def left(self) -> list[RowRun]:
        """Return what has not been looked at, finished runs first: then every table has them."""
        left = [run for run in self.runs if run.key not in self.done]
        return sorted(left, key=lambda run: not run.is_finished)

    def do(self, run: RowRun, on_progress: Progress, *, is_last: bool) -> bool:
        """Have a run's outcome, unless another process is at it; tell whether it is a new one."""
        is_new, reason = run.key in self._to_do and not run.is_finished, None
        if not run.is_finished:
            reason = self._absent.get(run.name) or self._readiness.why_not(run.config)
        if is_new and not reason:
            logger.info("%s, %s", *run.key)
        start_s = time.monotonic()
        tools = self._readiness, self._opened
        try:
            found = run.without(reason) if reason else run.outcome(*tools, on_progress)
        except TakenError as error:
            if is_last:
                self.done[run.key] = run.without(f"{error}: run this again when it has ended")
            return False
        self.done[run.key] = found
        if is_new and not found.reason:
            seconds = time.monotonic() - start_s
            self._pace.note(run.key, seconds)
            row, name = run.key
            logger.info("%s, %s: %s; %s", row, name, in_words(seconds), self._pace.left())
            return True
        self._pace.drop(run.key)
        return is_new and not reason

    def outcomes(self, settings: Sequence[Setting]) -> list[Outcome]:
        """Return the outcomes of all runs row by row; what has none says that it is to come."""
        found = {run.key: self.done.get(run.key) or run.without(NOT_YET) for run in self.runs}
        order = [setting.name for setting in settings]
        return sorted(found.values(), key=lambda outcome: order.index(outcome.setting))
