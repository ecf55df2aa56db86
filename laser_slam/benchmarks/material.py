"""The inputs of a table, below one data folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from laser_slam.benchmarks.stretch import Stretch
from laser_slam.benchmarks.table import SequenceSpec
from laser_slam.config import Config
from laser_slam.datasets import DATASETS
from laser_slam.datasets.base import Dataset
from laser_slam.dependencies import import_named
from laser_slam.errors import DatasetError

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
        dataset = self._open(spec, config)
        return dataset if spec.frames is None else Stretch(dataset, *spec.frames)

    def _open(self, spec: SequenceSpec, config: Config) -> Dataset:
        if spec.reader == "synthetic":
            return _make(spec, config.synthetic)
        if spec.reader == ALONG_PATH:
            from laser_slam.datasets.synthetic.drive import SyntheticDrive  # noqa: PLC0415

            return SyntheticDrive.from_poses_file(self._find(spec), config.synthetic)
        if spec.reader not in DATASETS:
            raise DatasetError(f"laser-slam has no reader '{spec.reader}'")
        return _make(spec, self._find(spec))

    def _find(self, spec: SequenceSpec) -> Path:
        if self.root is None:
            raise DatasetError(
                f"needs {spec.at[0]}; pass --data, or set LASER_SLAM_DATA, to the folder of it"
            )
        for place in spec.at:
            found = sorted(self.root.glob(place)) if "*" in place else [self.root / place]
            for path in found:
                if path.exists():
                    return path
        folders = [place.rpartition("/")[0] for place in spec.at if "/" in place] or spec.at
        raise DatasetError(
            f"not there, in {' or '.join(dict.fromkeys(folders))} of the data folder"
        )


def _make(spec: SequenceSpec, source: object) -> Dataset:
    reader = import_named(DATASETS, spec.reader, "reader")
    dataset: Dataset = reader(source, **spec.arguments)
    return dataset
