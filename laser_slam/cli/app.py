"""Commands: options to settings, errors in one line."""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from laser_slam import __version__
from laser_slam.errors import LaserSlamError

if TYPE_CHECKING:
    from laser_slam.config import Config
    from laser_slam.datasets.base import Dataset

INTERRUPTED = 130  # as shells report Ctrl-C
HELP_NAMES = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    help="Turn a drive from one camera into a trajectory and a dense coloured map.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=HELP_NAMES,
)

ConfigOption = Annotated[
    str | None, typer.Option("--config", help="Settings file, or the name of a shipped one.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="A setting: section.key=value; repeatable.")
]
BackboneOption = Annotated[
    str | None, typer.Option("--backbone", help="Source of depth and poses: backbone.name.")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Run folder, or a broken-off run to go on with."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Only warnings and the result.")]


@dataclass(frozen=True)
class RunOptions:
    """Options of whatever is done with a data set."""

    backbone: BackboneOption = None
    config: ConfigOption = None
    set: SetOption = None
    out: OutOption = None
    quiet: QuietOption = False

    def settings(self, base: Mapping[str, Any] | None = None) -> Config:
        """Resolve the settings, over those of the code or another base."""
        assignments = list(self.set or [])
        if self.backbone is not None:
            assignments.append(f"backbone.name={json.dumps(self.backbone)}")
        return resolve(self.config, assignments, base)

    def work(self, dataset: Dataset, config: Config) -> None:
        """Do what the command is for."""
        raise NotImplementedError


def resolve(
    file: str | None, assignments: list[str], base: Mapping[str, Any] | None = None
) -> Config:
    """Layer the settings: a file, or a shipped one by its name, and assignments."""
    from laser_slam.config import load_config, shipped_configs

    path = None if file is None else Path(file)
    if path is not None and not path.exists():
        shipped = shipped_configs() / f"{file}.yaml"
        path = shipped if shipped.exists() else path
    return load_config(None, path, assignments, base)


def command(
    function: Callable[..., None],
    name: str | None = None,
    *,
    group: typer.Typer = app,
    options: type[Any] = RunOptions,
    verb: str = "",
) -> Callable[..., None]:
    """Make a function a command: its ``options`` become flags, its errors one line.

    Known errors exit with 1, Ctrl-C with 130; everything else is a bug and keeps its traceback.

    Args:
        function: whose parameter ``options``, if it has one, takes the shared options.
        name: of the command; None: the function's.
        group: that it belongs to.
        options: dataclass of the options that it takes.
        verb: what is done with what the docstring names; empty: the docstring says it.
    """
    hints = get_type_hints(function, include_extras=True)
    parameters = inspect.signature(function).parameters
    own = [parameters[key].replace(annotation=hints[key]) for key in parameters]
    shared = _shared_parameters(options) if "options" in parameters else []
    own = [parameter for parameter in own if parameter.name != "options"]

    @functools.wraps(function)
    def run(**arguments: Any) -> None:
        if shared:
            chosen = {parameter.name: arguments.pop(parameter.name) for parameter in shared}
            arguments["options"] = options(**chosen)
        try:
            function(**arguments)
        except LaserSlamError as error:
            typer.echo(f"laser-slam: {error}", err=True)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as error:
            typer.echo("laser-slam: interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from error

    run.__signature__ = inspect.Signature(own + shared)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in own + shared}
    text = inspect.getdoc(function) or ""
    group.command(name, help=f"{verb} {text[0].lower()}{text[1:]}" if verb else text)(run)
    return run


def _shared_parameters(options: type[Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(options, include_extras=True)
    kind = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(field.name, kind, default=field.default, annotation=hints[field.name])
        for field in fields(options)
    ]


def _show_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"laser-slam {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Say which.")
    ] = False,
) -> None:
    """Turn a drive from one camera into a trajectory and a dense coloured map."""
