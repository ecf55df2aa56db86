"""The inputs of a table, below one data folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from laser_slam.benchmarks.stretch import Stretch
from laser_slam.benchmarks.table import GENERATED, SequenceSpec
from laser_slam.config import Config, SyntheticConfig
from laser_slam.datasets import DATASETS
from laser_slam.datasets.base import Dataset
from laser_slam.dependencies import import_named
from laser_slam.errors import DatasetError, LaserSlamError

ALONG_PATH = "path"  # a generated drive along true poses


@dataclass(frozen=True)
class Material:
    """Where data sets lie.

    Attributes:
        root: the folder that holds them; None: there is none.
    """

    root: Path | None

    def open(self, spec: SequenceSpec, config: Config) -> Dataset:
        """Open an input of a table.

        Raises:
            LaserSlamError: it is not there, there is no reader for it, or it cannot be read.
        """
        if spec.reader == GENERATED:
            return _cut(_make(spec, config.synthetic), spec)
        places = self._find(spec)
        refusals: list[DatasetError] = []
        for path, is_prepared in places:
            try:
                dataset = _open_at(spec, path, config)
                return dataset if is_prepared else _cut(dataset, spec)
            except DatasetError as error:
                refusals.append(error)
        if refusals:
            raise DatasetError(_without_name(str(refusals[0]), spec)) from refusals[0]
        raise DatasetError(_not_there(spec))

    def look(self, spec: SequenceSpec, config: Config) -> tuple[int, str | None]:
        """Return how many frames an input has, 0: not known, and why it cannot be read.

        What is generated is only looked for.
        """
        try:
            if spec.reader in {ALONG_PATH, GENERATED}:
                is_there = spec.reader == GENERATED or bool(self._find(spec))
                return spec.num_frames or 0, None if is_there else _not_there(spec)
            return self.open(spec, config).info.num_frames or 0, None
        except LaserSlamError as error:
            return 0, str(error)

    def _find(self, spec: SequenceSpec) -> list[tuple[Path, bool]]:
        """Return the places that are there, and whether they hold the chosen frames alone."""
        if self.root is None:
            raise DatasetError(
                f"needs {spec.at[0].partition('/')[0]}; pass --data, or set LASER_SLAM_DATA, to "
                "the folder that holds it"
            )
        return [
            (path, places is spec.prepared)
            for places in (spec.at, spec.prepared)
            for place in places
            for path in (sorted(self.root.glob(place)) if "*" in place else [self.root / place])
            if path.exists()
        ]


def _without_name(refusal: str, spec: SequenceSpec) -> str:
    """Cut what differs between sequences that are missing alike, and options of other commands."""
    what = refusal.partition("; pass --")[0]
    for value in spec.arguments.values():
        what = re.sub(rf" {re.escape(str(value))}\b", "", what, count=1)
    return what


def _not_there(spec: SequenceSpec) -> str:
    folder = spec.at[0].partition("/")[0]
    return f"not there, neither in {folder} nor elsewhere in the data folder"


class LastOpened:
    """The input that was opened last: the rows of a sequence follow one another."""

    def __init__(self) -> None:
        self._known: tuple[SequenceSpec, SyntheticConfig, Dataset] | None = None

    def open(self, material: Material, spec: SequenceSpec, config: Config) -> Dataset:
        """Open an input, or return it if it is the last one; see ``Material.open``."""
        if self._known is None or self._known[:2] != (spec, config.synthetic):
            self._known = spec, config.synthetic, material.open(spec, config)
        return self._known[2]


def _open_at(spec: SequenceSpec, path: Path, config: Config) -> Dataset:
    if spec.reader == ALONG_PATH:
        from laser_slam.datasets.synthetic.drive import SyntheticDrive  # noqa: PLC0415

        return SyntheticDrive.from_poses_file(path, config.synthetic)
    if spec.reader not in DATASETS:
        raise DatasetError(f"laser-slam has no reader '{spec.reader}'")
    return _make(spec, path)


def _cut(dataset: Dataset, spec: SequenceSpec) -> Dataset:
    return dataset if spec.frames is None else Stretch(dataset, *spec.frames)


def _make(spec: SequenceSpec, source: object) -> Dataset:
    reader = import_named(DATASETS, spec.reader, "reader")
    dataset: Dataset = reader(source, **spec.arguments)
    return dataset
