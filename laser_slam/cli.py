"""The command line: options to settings, a run with progress, errors in one line."""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from laser_slam import __version__
from laser_slam.errors import ConfigError, LaserSlamError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from laser_slam.config import Config
    from laser_slam.datasets.base import Dataset
    from laser_slam.pipeline import Pipeline

INTERRUPTED = 130  # as shells report Ctrl-C

app = typer.Typer(
    help="Turn a drive from one camera into a trajectory and a dense coloured map.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
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
IntrinsicsOption = Annotated[
    str | None, typer.Option("--intrinsics", help="fx,fy,cx,cy in pixels of the images.")
]
FovOption = Annotated[
    float | None, typer.Option("--fov", help="Horizontal field of view, degrees.")
]


@dataclass(frozen=True)
class RunOptions:
    """Options that all runs share."""

    backbone: BackboneOption = None
    config: ConfigOption = None
    set: SetOption = None
    out: OutOption = None
    quiet: QuietOption = False

    def settings(self) -> Config:
        """Resolve the settings."""
        assignments = list(self.set or [])
        if self.backbone is not None:
            assignments.append(f"backbone.name={json.dumps(self.backbone)}")
        return _resolve(self.config, assignments)


def command(function: Callable[..., None], name: str | None = None) -> Callable[..., None]:
    """Make a function a command: its ``options`` become flags, its errors one line.

    The command has the function's name, unless one is given that no function can have.

    Known errors exit with 1, Ctrl-C with 130; everything else is a bug and keeps its traceback.
    """
    hints = get_type_hints(function, include_extras=True)
    parameters = inspect.signature(function).parameters
    own = [parameters[name].replace(annotation=hints[name]) for name in parameters]
    shared = _shared_parameters() if "options" in parameters else []
    own = [parameter for parameter in own if parameter.name != "options"]

    @functools.wraps(function)
    def run(**arguments: Any) -> None:
        if shared:
            chosen = {parameter.name: arguments.pop(parameter.name) for parameter in shared}
            arguments["options"] = RunOptions(**chosen)
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
    app.command(name)(run)
    return run


def _shared_parameters() -> list[inspect.Parameter]:
    hints = get_type_hints(RunOptions, include_extras=True)
    kind = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(field.name, kind, default=field.default, annotation=hints[field.name])
        for field in fields(RunOptions)
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


@command
def demo(
    options: RunOptions,
    save_dataset: Annotated[
        Path | None,
        typer.Option(help="Only write the drive here, in KITTI's layout with depth maps."),
    ] = None,
) -> None:
    """Map a generated drive that comes back to its start; score it against the truth."""
    from laser_slam.datasets.synthetic.drive import SyntheticDrive

    config = options.settings()
    dataset = SyntheticDrive(config.synthetic)
    if save_dataset is None:
        _map(dataset, config, options)
        return
    from laser_slam.datasets.synthetic.save import save_kitti_layout

    save_kitti_layout(dataset, save_dataset, "00")
    typer.echo(f"saved; map it with: laser-slam kitti 00 --root {save_dataset}")


@command
def kitti(
    sequence: Annotated[str, typer.Argument(metavar="SEQ", help="Such as 03.")],
    options: RunOptions,
    root: Annotated[
        Path | None,
        typer.Option(envvar="LASER_SLAM_KITTI", help="Folder that holds 'sequences'."),
    ] = None,
) -> None:
    """Map a sequence of KITTI odometry; score it where poses are there."""
    from laser_slam.datasets.kitti import KittiOdometry

    if root is None:
        raise ConfigError(
            "no KITTI folder; pass --root, or set LASER_SLAM_KITTI, to the folder that holds "
            "'sequences'"
        )
    _map(KittiOdometry(root, sequence), options.settings(), options)


@functools.partial(command, name="7scenes")
def seven_scenes(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Such as kitchen/seq-01.")],
    options: RunOptions,
) -> None:
    """Map a sequence of 7-Scenes; score it against its poses and depth."""
    from laser_slam.datasets.seven_scenes import SevenScenes

    _map(SevenScenes(folder), options.settings(), options)


@command
def images(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Or a pattern: 'DIR/*.png'.")],
    options: RunOptions,
    intrinsics: IntrinsicsOption = None,
    fov: FovOption = None,
) -> None:
    """Map the images of a folder, in natural order of their names."""
    from laser_slam.datasets.images import ImageFolder

    config = options.settings()
    dataset = ImageFolder(folder, _parse_intrinsics(intrinsics), fov, config.dataset.fps)
    _map(dataset, config, options)


@command
def video(
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    options: RunOptions,
    intrinsics: IntrinsicsOption = None,
    fov: FovOption = None,
) -> None:
    """Map a video file."""
    from laser_slam.datasets.video import VideoFile

    config = options.settings()
    dataset = VideoFile(file, _parse_intrinsics(intrinsics), fov, config.dataset.stride)
    _map(dataset, config, options)


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
    """Print all settings, resolved."""
    from laser_slam.config import dump_config

    typer.echo(dump_config(_resolve(config, set or [])), nl=False)


def main() -> None:
    """Run the command line."""
    app(prog_name="laser-slam")


def _resolve(file: str | None, assignments: list[str]) -> Config:
    from laser_slam.config import load_config, shipped_configs

    path = None if file is None else Path(file)
    if path is not None and not path.exists():
        shipped = shipped_configs() / f"{file}.yaml"
        path = shipped if shipped.exists() else path
    return load_config(None, path, assignments)


def _parse_intrinsics(text: str | None) -> NDArray[np.float64] | None:
    from laser_slam.camera import intrinsics_matrix

    if text is None:
        return None
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--intrinsics wants fx,fy,cx,cy, got '{text}'") from error
    return intrinsics_matrix(fx, fy, cx, cy)


def _map(dataset: Dataset, settings: Config, options: RunOptions) -> None:
    from laser_slam.console import print_summary, progress_display
    from laser_slam.pipeline import Pipeline

    with progress_display(quiet=options.quiet) as on_progress:
        pipeline = Pipeline(dataset, settings, options.out, on_progress=on_progress)
        try:
            results = pipeline.run()
        except KeyboardInterrupt as error:
            typer.echo(_how_to_go_on(pipeline), err=True)
            raise typer.Exit(INTERRUPTED) from error
    print_summary(results.report, results.folder)


def _how_to_go_on(pipeline: Pipeline) -> str:
    folder = pipeline.folder
    kept = len(list((folder / "windows").glob("*.npz")))
    if kept == 0:
        return "laser-slam: interrupted; nothing is kept"
    way = "goes on"
    if pipeline.backbone.remembers:
        way = "starts again there, for this backbone needs the windows before"
    return (
        f"laser-slam: interrupted; {kept} windows are kept in {folder}; "
        f"the same command with --out {folder} {way}"
    )
