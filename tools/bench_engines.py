"""How much faster two workers predict than one: wall time of the same job, in one run.

    tools/bench_engines.py [--workers 1,2] [--cores 1] [--set section.key=value ...]

The generated drive, classical backbone, windows predicted by Ray; the time starts when all workers
are ready, so that their start does not count.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from laser_slam.config import Config, load_config
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.save import save_kitti_layout
from laser_slam.predicting import Fleet, Job


def main() -> None:
    """Print a row for each number of workers."""
    options = _parser().parse_args()
    config = load_config(assignments=["calibration.keyframes=0", *options.set])
    fleet = Fleet(cores=options.cores)
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        save_kitti_layout(SyntheticDrive(config.synthetic), scratch / "drive", "00")
        dataset = KittiOdometry(scratch / "drive", "00")
        print("| workers | cores each | windows | s | times as fast |\n|---|---|---|---|---|")
        first: float | None = None
        for num in options.workers:
            row = replace(fleet, num_workers=num)
            seconds, windows = _time(dataset, config, scratch / f"{num}", row)
            first = first or seconds
            ratio = first / seconds
            print(f"| {num} | {options.cores} | {windows} | {seconds:.1f} | {ratio:.2f} |")


def _time(dataset: Dataset, config: Config, out: Path, fleet: Fleet) -> tuple[float, int]:
    """Return seconds from when the workers are ready to the last window, and how many there are."""
    marks: list[float] = []

    def note(stage: str, done: int, total: int | None) -> None:
        marks.append(time.perf_counter())

    Job(dataset, config, out, fleet=fleet, on_progress=note).run()
    return marks[-1] - marks[0], len(marks) - 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--workers", type=lambda text: [int(n) for n in text.split(",")], default=[1, 2]
    )
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--set", action="append", default=[])
    return parser


if __name__ == "__main__":
    main()
