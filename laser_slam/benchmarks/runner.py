"""Every row of a table on every sequence: run once, kept, and scored as the columns ask."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from laser_slam.benchmarks.material import Material
from laser_slam.benchmarks.measures import MEASURES, Scores
from laser_slam.benchmarks.protocols import PROTOCOLS
from laser_slam.benchmarks.settings import Setting
from laser_slam.benchmarks.sharing import predict_once, replayed, shared_folder
from laser_slam.benchmarks.table import Table
from laser_slam.bookkeeping import Progress, identify, no_progress
from laser_slam.config import Config, assigned, load_config
from laser_slam.datasets.base import Dataset
from laser_slam.errors import ConfigError, LaserSlamError, RunFolderError
from laser_slam.pipeline import Pipeline
from laser_slam.predicting import settle
from laser_slam.predicting.manifest import read_identity
from laser_slam.results import read_report
from laser_slam.store import name_differences, write_text

logger = logging.getLogger(__name__)

SCORES = "bench.json"  # in a run's folder: what protocols beyond the run itself have found
RUN = "run"


def plain_settings(below: Sequence[str], above: Sequence[str]) -> Config:
    """Resolve the settings of sequence and row over those of the table, with none of a user."""
    return load_config(assignments=above, base=assigned(below))


@dataclass(frozen=True)
class Outcome:
    """What became of one row on one sequence.

    Attributes:
        setting: name of the row.
        sequence: its name in the table.
        scores: results by protocol; empty: it was not run.
        reason: why there are none; None: there are.
        part: which part of the sequence was there; None: the whole, or nobody knows.
    """

    setting: str
    sequence: str
    scores: Scores = field(default_factory=dict)
    reason: str | None = None
    part: str | None = None


@dataclass(frozen=True)
class Bench:
    """A table to run.

    Attributes:
        table: what is run and shown.
        material: where the data lie.
        out: holds a folder for each row, with a run's folder for each sequence.
        resolve: layers the user's settings between the ``section.key=value`` of the table, which
            lie below, and those of sequence and row, which lie above.
        only: names of sequences or groups; none: all.
        is_shared: rows that cut the same windows map one prediction of them; the backbone is then
            not asked about loops.
    """

    table: Table
    material: Material
    out: Path
    resolve: Callable[[Sequence[str], Sequence[str]], Config] = plain_settings
    only: tuple[str, ...] = ()
    is_shared: bool = False

    def sequences(self) -> list[str]:
        """Return the names of the sequences that are run, in the table's order.

        Raises:
            LaserSlamError: one that is asked for is none.
        """
        groups = {**self.table.groups, **{name: (name,) for name in self.table.sequences}}
        unknown = [name for name in self.only if name not in groups]
        if unknown:
            there = ", ".join(groups)
            raise ConfigError(f"--only {unknown[0]}: no such sequence; there is {there}")
        wanted = {name for group in self.only for name in groups[group]}
        return [name for name in self.table.sequences if name in wanted or not self.only]

    def run(
        self, settings: Sequence[Setting], on_progress: Progress = no_progress
    ) -> list[Outcome]:
        """Run what has not been run yet, and score it; what fails becomes a reason.

        Args:
            settings: the rows.
            on_progress: called with a stage's name, how much is done and of how much.

        Raises:
            LaserSlamError: a setting is unknown, or a sequence that is asked for is none.
        """
        sequences = self.sequences()
        configs = {
            (setting.name, name): self._config(setting, name)
            for setting in settings
            for name in sequences
        }
        outcomes = []
        for setting in settings:
            for name in sequences:
                on_progress(f"bench {setting.name}", sequences.index(name), len(sequences))
                one = _One(self, setting, name, configs[setting.name, name])
                outcomes.append(one.outcome(on_progress))
            on_progress(f"bench {setting.name}", len(sequences), len(sequences))
        return outcomes

    def _config(self, setting: Setting, name: str) -> Config:
        spec = self.table.sequences[name]
        return self.resolve(self.table.settings, [*spec.settings, *setting.assignments])


@dataclass(frozen=True)
class _One:
    """One row on one sequence."""

    bench: Bench
    setting: Setting
    name: str
    config: Config

    @property
    def folder(self) -> Path:
        return self.bench.out / self.setting.folder / self.name

    def outcome(self, on_progress: Progress) -> Outcome:
        try:
            spec = self.bench.table.sequences[self.name]
            dataset = self.bench.material.open(spec, self.config)
            scores = self._scores(dataset, on_progress)
        except LaserSlamError as error:
            logger.warning("%s, %s: %s", self.setting.name, self.name, error)
            return Outcome(self.setting.name, self.name, reason=self._portable(str(error)))
        except (MemoryError, RuntimeError, OSError) as error:  # a GPU's memory is a RuntimeError
            logger.exception("%s, %s broke off", self.setting.name, self.name)
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]
            return Outcome(self.setting.name, self.name, reason=self._portable(reason))
        num, whole = dataset.info.num_frames, spec.num_frames
        part = f"{num} of {whole} frames" if num and whole and num < whole else None
        return Outcome(self.setting.name, self.name, scores, part=part)

    def _portable(self, text: str) -> str:
        """Name folders as anybody may, who makes the same table elsewhere."""
        places = {self.bench.out: "RUNS", self.bench.material.root: "DATA"}
        for place, word in places.items():
            if place is not None and place != Path():
                text = text.replace(str(place), word)
        return text

    def _scores(self, dataset: Dataset, on_progress: Progress) -> dict[str, Any]:
        config = self.config
        if self.bench.is_shared:
            shared = shared_folder(config, self.bench.out, self.name)
            config = replayed(config, shared)
        if (self.folder / "report.json").exists():
            self._refuse_another_run(dataset, config)
        else:
            if self.bench.is_shared:
                predict_once(dataset, self.config, shared, on_progress)
            Pipeline(dataset, config, self.folder, on_progress=on_progress).run()
        scores = _read_scores(self.folder / SCORES)
        wanted = {MEASURES[name].protocol for name in self.bench.table.measures_of(self.name)}
        for protocol in sorted(wanted - scores.keys() - {RUN}):
            scores[protocol] = PROTOCOLS[protocol](self.folder, dataset)
            write_text(self.folder / SCORES, json.dumps(scores, indent=2) + "\n")
        return {**scores, RUN: _numbers(self.folder)}

    def _refuse_another_run(self, dataset: Dataset, config: Config) -> None:
        """Refuse a finished run whose settings or input are not those of the row."""
        settings = load_config(file=self.folder / "config.yaml").model_dump(mode="json")
        wanted = settle(config, dataset.info, self.folder).model_dump(mode="json")
        pairs = {
            "settings": (settings, wanted),
            "input": (read_identity(self.folder), identify(dataset)),
        }
        for what, (stored, now) in pairs.items():
            differences = name_differences(stored, now)
            if differences:
                raise RunFolderError(
                    f"{self.folder} holds a run with other {what}: {differences}; remove it, or "
                    "choose another folder with --out"
                )


def _numbers(folder: Path) -> dict[str, Any]:
    """Read the report, without what a table has no use for."""
    report = dict(read_report(folder))
    windows = report.get("windows") or {}
    num_bridged = len(windows.get("bridged") or ())
    kept = ("trajectory", "depth", "closures", "frames", "frames_per_second")
    numbers = {name: report.get(name) for name in kept}
    return {**numbers, "windows": {"num": windows.get("num"), "num_bridged": num_bridged}}


def _read_scores(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunFolderError(
            f"cannot read {path}; remove it, it will be worked out anew"
        ) from error
    return found if isinstance(found, dict) else {}
