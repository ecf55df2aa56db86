"""The command that runs a table of benchmarks."""

from __future__ import annotations

import functools
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from laser_slam.cli.app import (
    INTERRUPTED,
    BackboneOption,
    ConfigOption,
    QuietOption,
    SetOption,
    command,
    resolve,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from laser_slam.benchmarks import Bench, Outcome, Setting
    from laser_slam.config import Config

WIDTH = 200  # of what is printed to no terminal

DataOption = Annotated[
    Path | None,
    typer.Option(
        "--data",
        envvar="LASER_SLAM_DATA",
        exists=True,
        file_okay=False,
        help="Folder that holds the data sets.",
    ),
]
SettingOption = Annotated[
    list[str] | None,
    typer.Option(
        "--setting",
        help="A row: NAME=section.key=value,...; or the name of one of the table's, or of a group "
        "of them; repeatable. Default: all of the table's.",
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
LeanOption = Annotated[
    bool,
    typer.Option(
        "--lean",
        help="Keep scores, paths and report of each run; remove its windows, layers and map.",
    ),
]
ListOption = Annotated[
    bool,
    typer.Option(
        "--list", help="Show rows and sequences, and which are there and finished; run nothing."
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Holds all runs; the same command goes on where it stopped, and several may work at "
        "once. Default: runs/TABLE.",
    ),
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
    lean: LeanOption = False
    list: ListOption = False
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
            ("--config", None if self.config is None else Path(self.config).name),
        ):
            parts += [] if value is None else [flag, value]
        for flag, values in (("--setting", self.setting), ("--set", self.set)):
            parts += [part for value in values or [] for part in (flag, value)]
        parts += [
            flag for flag, is_set in (("--share", self.share), ("--lean", self.lean)) if is_set
        ]
        return shlex.join(parts) + ("" if self.data is None else " --data DATA")


@functools.partial(command, options=BenchFlags)
def bench(
    options: BenchFlags,
    table: Annotated[
        str | None,
        typer.Argument(
            metavar="TABLE",
            help="here, kitti, depth, pose, points, waymo or ablation; a YAML file of your own; "
            "none: list them.",
        ),
    ] = None,
) -> None:
    """Run a whole table of the paper, and print it beside what others have published."""
    from laser_slam.benchmarks import Bench, Material, list_tables, load_table, parse_settings

    if table is None:
        _print_pairs("Tables, each for laser-slam bench TABLE", list_tables())
        return
    chosen = load_table(table)
    out = options.out or Path("runs") / Path(table).stem
    settings = parse_settings(options.setting or [], chosen)
    only = tuple(part.strip() for part in (options.only or "").split(",") if part.strip())
    material = Material(options.data)
    place = chosen, material, out, options.share, options.lean
    work = Bench(*place, resolve=options.resolve, only=only)
    if options.list:
        _show_plan(work, settings)
        return
    _run(work, settings, Path(table), options)


def _run(work: Bench, settings: Sequence[Setting], table: Path, options: BenchFlags) -> None:
    """Run the table, keep what is known after each run, print it at the end."""
    from rich.console import Console

    from laser_slam.benchmarks import Report, fill_grids, print_grids, save_table
    from laser_slam.console import progress_display

    def save(outcomes: Sequence[Outcome], page: Path | None = None) -> list[Path]:
        command = options.command(table.name)
        report = Report(table.stem, work.table, settings, outcomes, command)
        return save_table(work.out, report, page)

    try:
        with progress_display(quiet=options.quiet) as on_progress:
            outcomes = work.run(settings, on_progress, save)
    except KeyboardInterrupt as error:
        runs = work.runs(settings)
        num = sum(run.is_finished for run in runs)
        typer.echo(
            f"laser-slam: interrupted; {num} of {len(runs)} runs are finished in {work.out}; "
            "the same command goes on",
            err=True,
        )
        raise typer.Exit(INTERRUPTED) from error
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    print_grids(work.table, fill_grids(work.table, outcomes), outcomes, console)
    for path in save(outcomes, options.page):
        typer.echo(path)
    if not any(outcome.scores for outcome in outcomes):
        typer.echo("laser-slam: no row has a number; the notes say why", err=True)
        raise typer.Exit(1)


def _show_plan(work: Bench, settings: Sequence[Setting]) -> None:
    from laser_slam.benchmarks import list_groups, list_rows, list_sequences

    sequences = list(list_sequences(work, settings))  # which refuses what is wrong
    typer.echo(f"{work.table.title}\n\n{work.table.about.strip()}\n")
    _print_pairs("Rows", list_rows(settings))
    _print_pairs("Groups of rows, for --setting", list_groups(work.table.row_groups))
    _print_pairs("Groups of sequences, for --only", list_groups(work.table.groups))
    _print_pairs("Sequences", sequences)


def _print_pairs(title: str, pairs: Iterable[tuple[str, str]]) -> None:
    from rich.console import Console
    from rich.table import Table as Drawn
    from rich.text import Text

    drawn = Drawn(title=Text(title, style="bold"), title_justify="left", box=None)
    drawn.show_header = False
    for pair in pairs:
        drawn.add_row(*map(Text, pair))
    if drawn.row_count:
        Console().print(drawn)
