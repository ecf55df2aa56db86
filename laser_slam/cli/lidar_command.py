"""The commands that go by laser scans, and the one that maps a drive of KITTI's raw data."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from laser_slam.cli.app import HELP_NAMES, QuietOption, RunOptions, app, command
from laser_slam.cli.sources import RootOption, open_kitti, source

if TYPE_CHECKING:
    from laser_slam.lidar import LidarDataset

lidar_app = typer.Typer(
    help="Find a sequence's metric path by its laser scans (KISS-ICP); compare a run with them.",
    no_args_is_help=True,
    context_settings=HELP_NAMES,
)

CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="Folder of calib_*.txt, or KITTI's date, such as 2011_09_26. [DIR, or the one above]",
    ),
]
DriveArgument = Annotated[
    Path, typer.Argument(metavar="DIR", help="Such as 2011_09_26/2011_09_26_drive_0001_sync.")
]
PathOption = Annotated[
    Path | None, typer.Option("--out", help="Folder to be. [runs/SEQUENCE-lidar-TIME]")
]
RunOption = Annotated[
    Path | None, typer.Option("--run", help="A finished run to compare, such as runs/latest.")
]


@dataclass(frozen=True)
class LidarFlags:
    """Options of the commands."""

    out: PathOption = None
    run: RunOption = None
    quiet: QuietOption = False

    def work(self, dataset: LidarDataset) -> None:
        """Track the scans and print what they say."""
        from laser_slam.console import progress_display
        from laser_slam.lidar import make_reference, summarize_lidar

        with progress_display(quiet=self.quiet) as on_progress:
            reference = make_reference(dataset, self.out, self.run, on_progress)
        for name, text in summarize_lidar(reference.report):
            typer.echo(f"{name:13} {text}")
        typer.echo(f"{'files':13} {reference.folder}")


@functools.partial(source, name="kitti-raw")
def kitti_raw(
    folder: DriveArgument, options: RunOptions, calibration: CalibrationOption = None
) -> None:
    """A drive of KITTI's raw data, its depth scored against LiDAR where scans are there."""
    from laser_slam.datasets.kitti_raw import KittiRaw

    options.work(KittiRaw(folder, calibration), options.settings())


@functools.partial(command, name="kitti", group=lidar_app, options=LidarFlags)
def lidar_kitti(
    sequence: Annotated[str, typer.Argument(metavar="SEQ", help="Such as 03.")],
    options: LidarFlags,
    root: RootOption = None,
) -> None:
    """A sequence of KITTI odometry with its folder 'velodyne'."""
    options.work(open_kitti(sequence, root))


@functools.partial(command, name="kitti-raw", group=lidar_app, options=LidarFlags)
def lidar_kitti_raw(
    folder: DriveArgument, options: LidarFlags, calibration: CalibrationOption = None
) -> None:
    """A drive of KITTI's raw data with its folder 'velodyne_points'."""
    from laser_slam.datasets.kitti_raw import KittiRaw

    options.work(KittiRaw(folder, calibration))


app.add_typer(lidar_app, name="lidar")
