"""The command that shows a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from laser_slam.cli.app import QuietOption, command
from laser_slam.errors import ConfigError


@command
def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Such as runs/latest.")],
    save: Annotated[
        Path | None, typer.Option(help="Only write a recording that rerun opens: FILE.rrd.")
    ] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Show it in a browser.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file of --save.")] = False,
    port: Annotated[int, typer.Option(help="Of the page; the data use the one after it.")] = 9090,
    quiet: QuietOption = False,
) -> None:
    """Show a run as it went, finished or broken off: in a window, else in RUN/run.rrd."""
    from laser_slam.console import progress_display
    from laser_slam.viewer import BrowserSink, FileSink, Sink, WindowSink, has_display
    from laser_slam.viewing import RECORDING, view_run

    if save is not None and serve:
        raise ConfigError("--save writes a file and --serve shows a page; choose one")
    sink: Sink
    if serve:
        sink = BrowserSink(port)
    elif save is not None or not has_display():
        own = run / RECORDING
        is_own = save is None or save.resolve() == own.resolve()
        sink = FileSink(save or own, replace=force or is_own)
        sink.refuse_existing()  # before the run is read
    else:
        sink = WindowSink()
    with progress_display(quiet=quiet) as on_progress:
        num_windows = view_run(run, sink, on_progress)
    if isinstance(sink, FileSink):
        size = sink.path.stat().st_size / 1e6
        typer.echo(
            f"{num_windows} windows in {sink.path} ({size:.0f} MB); open it with: rerun {sink.path}"
        )
    elif isinstance(sink, BrowserSink):
        typer.echo(f"open {sink.url}; Ctrl-C ends it")
        sink.wait()
