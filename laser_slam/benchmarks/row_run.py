"""One row on one sequence: run once, kept, and scored as the columns ask."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from laser_slam.backbones import REPLAY
from laser_slam.backbones.base import Backbone
from laser_slam.benchmarks.claims import TakenError, claimed
from laser_slam.benchmarks.material import LastOpened, Material
from laser_slam.benchmarks.measures import MEASURES, PROTOCOL_VERSION
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.protocols import PROTOCOLS
from laser_slam.benchmarks.readiness import Readiness
from laser_slam.benchmarks.settings import Setting
from laser_slam.benchmarks.sharing import predict_once, replayed, shared_folder
from laser_slam.benchmarks.table import SequenceSpec, Table
from laser_slam.bookkeeping import Progress, identify
from laser_slam.config import Config, load_config
from laser_slam.datasets.base import Dataset
from laser_slam.errors import LaserSlamError, RunFolderError
from laser_slam.pipeline import Pipeline
from laser_slam.predicting import settle
from laser_slam.predicting.manifest import read_identity
from laser_slam.results import read_report
from laser_slam.store import name_differences, write_text

logger = logging.getLogger(__name__)

SCORES = "bench.json"  # in a run's folder: what protocols beyond the run itself have found
REPORT = "report.json"  # a run that has it is finished
RUN = "run"
ADVICE = "remove it, or choose another folder with --out"
BULK = ("windows", "layers", "tiles", "map.ply")  # of a run, no scores, and almost all its bytes


@dataclass(frozen=True)
class Place:
    """Where the runs of a table lie, and how.

    Attributes:
        table: that is run.
        material: where the data lie.
        out: holds a folder for each row, with a run's folder for each sequence.
        is_shared: rows that cut the same windows map one prediction of them; the backbone is then
            not asked about loops.
        is_lean: of a run that is scored, ``BULK`` is removed.
    """

    table: Table
    material: Material
    out: Path
    is_shared: bool = False
    is_lean: bool = False


@dataclass(frozen=True)
class RowRun:
    """One row on one sequence."""

    place: Place
    setting: Setting
    name: str
    config: Config

    @property
    def key(self) -> tuple[str, str]:
        """Return names of row and sequence."""
        return self.setting.name, self.name

    @property
    def folder(self) -> Path:
        """Return where its run lies."""
        return self.place.out / self.setting.folder / self.name

    @property
    def spec(self) -> SequenceSpec:
        """Return the sequence as the table describes it."""
        return self.place.table.sequences[self.name]

    @cached_property
    def shared(self) -> Path:
        """Return where its predictions lie if rows share them."""
        return shared_folder(self.config, self.place.out, self.name)

    @property
    def is_finished(self) -> bool:
        """Tell whether it was run before."""
        return (self.folder / REPORT).exists()

    def outcome(self, readiness: Readiness, opened: LastOpened, on_progress: Progress) -> Outcome:
        """Run it if it has not been run, and score it; what fails becomes a reason.

        Args:
            readiness: has networks.
            opened: has the input if it was that of the run before.
            on_progress: called with a stage's name, how much is done and of how much.

        Raises:
            TakenError: another process is at it.
        """
        try:
            dataset = opened.open(self.place.material, self.spec, self.config)
            with claimed(self.folder, to_read=self._is_done()):
                scores = self._scores(dataset, readiness, on_progress)
        except TakenError:
            raise
        except LaserSlamError as error:
            logger.warning("%s, %s: %s", self.setting.name, self.name, error)
            return self.without(str(error))
        # What breaks one run, be it a bug, is told with its traceback; the others go on.
        except Exception as error:
            logger.exception("%s, %s broke off", self.setting.name, self.name)
            return self.without(f"{type(error).__name__}: {' '.join(str(error).split())}"[:200])
        num, whole = dataset.info.num_frames, self.spec.num_frames
        part = f"{num} of {whole} frames" if num and whole and num < whole else None
        return Outcome(*self.key, scores, part=part, backbone=self.config.backbone.name)

    def without(self, reason: str) -> Outcome:
        """Return an outcome without numbers; folders are named as anybody may."""
        for place, word in ((self.place.out, "RUNS"), (self.place.material.root, "DATA")):
            if place is not None and place != Path():
                # The whole path only: with --out r, an r in a word is none.
                reason = re.sub(rf"(?<![\w./-]){re.escape(str(place))}(?![\w-])", word, reason)
        return Outcome(*self.key, reason=reason, backbone=self.config.backbone.name)

    def _is_done(self) -> bool:
        """Tell whether it is finished, scored and, if it shall be, lean: only read from now on."""
        if not self.is_finished or self._unscored(read_scores(self.folder / SCORES)):
            return False
        return not (self.place.is_lean and any((self.folder / name).exists() for name in BULK))

    def _unscored(self, scores: Mapping[str, Any]) -> list[str]:
        """Return the protocols that columns want and that have not been worked out."""
        wanted = {MEASURES[name].protocol for name in self.place.table.measures_of(self.name)}
        return sorted(wanted - scores.keys() - {RUN})

    def _scores(
        self, dataset: Dataset, readiness: Readiness, on_progress: Progress
    ) -> dict[str, Any]:
        config = replayed(self.config, self.shared) if self.place.is_shared else self.config
        if self.is_finished:
            self._refuse_another_run(dataset, config)
        else:
            self._run(dataset, config, readiness, on_progress)
        scores = read_scores(self.folder / SCORES)
        for protocol in self._unscored(scores):
            self._refuse_lean(protocol)
            scores[protocol] = PROTOCOLS[protocol](self.folder, dataset)
            kept = {"version": PROTOCOL_VERSION, "scores": scores}
            write_text(self.folder / SCORES, json.dumps(kept, indent=2) + "\n")
        if self.place.is_lean:
            remove_bulk(self.folder)
        return {**scores, RUN: _numbers(self.folder)}

    def _run(
        self, dataset: Dataset, config: Config, readiness: Readiness, on_progress: Progress
    ) -> None:
        backbone = readiness.backbone(self.config.backbone)
        if not self.place.is_shared:
            self._map(dataset, config, backbone, on_progress)
            return
        with claimed(self.shared):
            predict_once(dataset, self.config, self.shared, backbone, on_progress)
        with claimed(self.shared, to_read=True):
            self._map(dataset, config, None, on_progress)

    def _map(
        self, dataset: Dataset, config: Config, backbone: Backbone | None, on_progress: Progress
    ) -> None:
        pipeline = Pipeline(
            dataset, config, self.folder, backbone=backbone, on_progress=on_progress
        )
        pipeline.run()

    def _refuse_another_run(self, dataset: Dataset, config: Config) -> None:
        """Refuse a finished run whose settings or input are not those of the row."""
        stored = load_config(file=self.folder / "config.yaml")
        if (stored.backbone.name == REPLAY) != self.place.is_shared:
            how = "without" if self.place.is_shared else "with"
            raise RunFolderError(f"{self.folder} holds a run that was made {how} --share; {ADVICE}")
        if self.place.is_shared:
            # Its own folder says what the shared predictions were, wherever these are by now.
            stored, config = (replayed(each, self.folder) for each in (stored, config))
            stored = settle(stored, dataset.info, self.folder)
        wanted = settle(config, dataset.info, self.folder)
        pairs = {
            "settings": (stored.model_dump(mode="json"), wanted.model_dump(mode="json")),
            "input": (read_identity(self.folder), identify(dataset)),
        }
        for what, (old, new) in pairs.items():
            differences = name_differences(old, new)
            if differences:
                raise RunFolderError(
                    f"{self.folder} holds a run with other {what}: {differences}; {ADVICE}"
                )

    def _refuse_lean(self, protocol: str) -> None:
        if not (self.folder / "windows").is_dir():
            raise RunFolderError(
                f"{self.folder} has no windows any more (--lean) to work out {protocol} from; "
                "remove it, and it is run again"
            )


def remove_bulk(folder: Path) -> None:
    """Remove what takes the space of a run, and leave scores, paths and its report.

    Raises:
        RunFolderError: the system could not.
    """
    try:
        for name in BULK:
            path = folder / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise RunFolderError(f"cannot remove {path}: {error.strerror}") from error


def read_scores(path: Path) -> dict[str, Any]:
    """Read scores by protocol; none: there are none, or those of another version.

    Raises:
        RunFolderError: the file is damaged.
    """
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunFolderError(
            f"cannot read {path}; remove it, it will be worked out anew"
        ) from error
    if not isinstance(found, dict) or found.get("version") != PROTOCOL_VERSION:
        return {}
    return dict(found["scores"])


def _numbers(folder: Path) -> dict[str, Any]:
    """Read the report, without what a table has no use for."""
    report = dict(read_report(folder))
    windows = report.get("windows") or {}
    num_bridged = len(windows.get("bridged") or ())
    kept = ("trajectory", "depth", "closures", "frames", "frames_per_second")
    numbers = {name: report.get(name) for name in kept}
    return {**numbers, "windows": {"num": windows.get("num"), "num_bridged": num_bridged}}
