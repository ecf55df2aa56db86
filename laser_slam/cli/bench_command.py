"""The command that runs a table of benchmarks."""

from __future__ import annotations

import functools
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from laser_slam.cli.app import (
    BackboneOption,
    ConfigOption,
    QuietOption,
    SetOption,
    command,
    resolve,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from laser_slam.config import Config

WIDTH = 200  # of what is printed to no terminal

DataOption = Annotated[
    Path | None,
    typer.Option("--data", envvar="LASER_SLAM_DATA", help="Folder that holds the data sets."),
]
SettingOption = Annotated[
    list[str] | None,
    typer.Option(
        "--setting",
        help="A row: NAME=section.key=value,...; or one of the table's. Repeatable. [all of the "
        "table's]",
    ),
]
OnlyOption = Annotated[
    str | None, typer.Option("--only", help="Sequences or groups of the table: 03,06.")
]
ShareOption = Annotated[
    bool,
    typer.Option(
        "--share",
        help="Rows that cut the same windows map one prediction of them; the backbone is not "
        "asked about loops then.",
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Holds all runs; goes on where it stopped. [runs/TABLE]"),
]
PageOption = Annotated[
    Path | None, typer.Option("--page", help="Markdown page whose section of the table is renewed.")
]


@dataclass(frozen=True)
class BenchFlags:
    """Options of the command."""

    data: DataOption = None
    setting: SettingOption = None
    only: OnlyOption = None
    share: ShareOption = False
    backbone: BackboneOption = None
    config: ConfigOption = None
    set: SetOption = None
    out: OutOption = None
    page: PageOption = None
    quiet: QuietOption = False

    def resolve(self, below: Sequence[str], above: Sequence[str]) -> Config:
        """Layer the settings: the table's, the user's file and assignments, sequence and row."""
        from laser_slam.config import assigned

        mine = list(self.set or [])
        if self.backbone is not None:
            mine.append(f"backbone.name={self.backbone}")
        return resolve(self.config, [*mine, *above], assigned(below))

    def command(self, table: str) -> str:
        """Return the command that makes the same table, but for where things lie."""
        parts = ["laser-slam", "bench", table]
        for flag, value in (
            ("--only", self.only),
            ("--backbone", self.backbone),
            ("--config", self.config),
        ):
            parts += [] if value is None else [flag, value]
        for flag, values in (("--setting", self.setting), ("--set", self.set)):
            parts += [part for value in values or [] for part in (flag, value)]
        parts += ["--share"] if self.share else []
        return shlex.join(parts) + ("" if self.data is None else " --data DATA")


@functools.partial(command, options=BenchFlags)
def bench(
    table: Annotated[
        str,
        typer.Argument(metavar="TABLE", help="here, kitti, depth, pose, points, waymo, ablation."),
    ],
    options: BenchFlags,
) -> None:
    """Run a whole table of the paper, and print it beside what others have published."""
    from rich.console import Console

    from laser_slam.benchmarks import (
        Bench,
        Material,
        Report,
        fill_grids,
        load_table,
        parse_settings,
        print_grids,
        save_table,
    )
    from laser_slam.console import progress_display

    chosen = load_table(table)
    settings = parse_settings(options.setting or [], chosen)
    out = options.out or Path("runs") / table
    only = tuple(part.strip() for part in (options.only or "").split(",") if part.strip())
    work = Bench(chosen, Material(options.data), out, options.resolve, only, options.share)
    with progress_display(quiet=options.quiet) as on_progress:
        outcomes = work.run(settings, on_progress)
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    print_grids(fill_grids(chosen, outcomes), outcomes, console)
    report = Report(table, chosen, settings, outcomes, options.command(table))
    for path in save_table(out, report, options.page):
        typer.echo(path)
