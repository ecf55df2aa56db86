"""The commands that look at what is there: a finished run, the settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from laser_slam.cli.app import ConfigOption, SetOption, command, resolve


@command
def eval(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Such as runs/latest.")],
    truth: Annotated[
        Path | None, typer.Option(help="Poses in metres: KITTI's format, or TUM's.")
    ] = None,
) -> None:
    """Score a finished run again, perhaps against another truth."""
    from laser_slam.console import print_summary
    from laser_slam.rescoring import rescore

    print_summary(rescore(run, truth), run)


@command
def config(config: ConfigOption = None, set: SetOption = None) -> None:
    """Print all settings, resolved, with what they mean: YAML that --config takes."""
    from laser_slam.config import explain_config

    typer.echo(explain_config(resolve(config, set or [])), nl=False)
