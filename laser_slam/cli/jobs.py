"""What is done with a data set: map it, or only predict its windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from laser_slam.cli.app import HELP_NAMES, INTERRUPTED, RunOptions
from laser_slam.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from laser_slam.config import Config
    from laser_slam.datasets.base import Dataset

predict_app = typer.Typer(
    help="Predict the windows of a data set only; map them later, anywhere, with 'replay'.",
    no_args_is_help=True,
    context_settings=HELP_NAMES,
)


ViewOption = Annotated[
    bool, typer.Option("--view", help="Watch it in rerun; without a display: in RUN/run.rrd.")
]


@dataclass(frozen=True)
class MapOptions(RunOptions):
    """Options of a whole run."""

    view: ViewOption = False

    def work(self, dataset: Dataset, config: Config) -> None:
        """Map the data set."""
        from laser_slam.console import print_summary, progress_display
        from laser_slam.pipeline import Pipeline, no_viewer
        from laser_slam.viewing import live_viewer

        viewer = live_viewer if self.view else no_viewer
        with progress_display(quiet=self.quiet) as on_progress:
            pipeline = Pipeline(
                dataset, config, self.out, on_progress=on_progress, make_viewer=viewer
            )
            try:
                results = pipeline.run()
            except KeyboardInterrupt as error:
                text = _how_to_go_on(pipeline.folder, remembers=pipeline.source.remembers)
                typer.echo(text, err=True)
                raise typer.Exit(INTERRUPTED) from error
        print_summary(results.report, results.folder)


EngineOption = Annotated[
    Literal["local", "ray"],
    typer.Option("--engine", help="Who predicts: this process, or workers of Ray."),
]
AddressOption = Annotated[
    str | None,
    typer.Option("--address", help="Ray cluster: auto or HOST:PORT; else this machine."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", min=1, help="Of Ray; default: as many as have room."),
]
CoresOption = Annotated[
    int | None, typer.Option("--cores", min=1, help="Of each worker; default: of its GPU, or 2.")
]


@dataclass(frozen=True)
class PredictOptions(RunOptions):
    """Options of predicting alone."""

    engine: EngineOption = "local"
    address: AddressOption = None
    workers: WorkersOption = None
    cores: CoresOption = None

    def work(self, dataset: Dataset, config: Config) -> None:
        """Predict the windows of the data set."""
        from laser_slam.console import progress_display
        from laser_slam.predicting import Fleet, Job

        wanted = Fleet(self.address, self.workers, self.cores)
        if self.engine == "local" and wanted != Fleet():
            raise ConfigError("--address, --workers and --cores are for --engine ray")
        fleet = wanted if self.engine == "ray" else None
        with progress_display(quiet=self.quiet) as on_progress:
            job = Job(
                dataset,
                config,
                self.out,
                fleet=fleet if self.engine == "ray" else None,
                on_progress=on_progress,
            )
            try:
                num = job.run()
            except KeyboardInterrupt as error:
                typer.echo(_how_to_go_on(job.folder, remembers=job.source.remembers), err=True)
                raise typer.Exit(INTERRUPTED) from error
        typer.echo(f"{num} windows predicted; map them with: laser-slam replay {job.folder}")


def _how_to_go_on(folder: Path, *, remembers: bool) -> str:
    kept = len(list((folder / "windows").glob("*.npz")))
    if kept == 0:
        return "laser-slam: interrupted; nothing is kept"
    way = "starts again there, for this backbone needs the windows before"
    return (
        f"laser-slam: interrupted; {kept} windows are kept in {folder}; "
        f"the same command with --out {folder} {way if remembers else 'goes on'}"
    )
