"""The commands that open a data set: each maps it, and each can predict its windows only."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from laser_slam.cli.app import RunOptions, app, command
from laser_slam.cli.jobs import MapOptions, PredictOptions, predict_app
from laser_slam.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from laser_slam.datasets.kitti import KittiOdometry

IntrinsicsOption = Annotated[
    str | None, typer.Option("--intrinsics", help="fx,fy,cx,cy in pixels of the images.")
]
FovOption = Annotated[
    float | None, typer.Option("--fov", help="Horizontal field of view, degrees.")
]

RootOption = Annotated[
    Path | None,
    typer.Option("--root", envvar="LASER_SLAM_KITTI", help="Folder that holds 'sequences'."),
]


def open_kitti(sequence: str, root: Path | None) -> KittiOdometry:
    """Open a sequence of KITTI odometry below the folder that an option or a variable names."""
    from laser_slam.datasets.kitti import ROOT_ADVICE, KittiOdometry

    if root is None:
        raise ConfigError(f"no KITTI folder; {ROOT_ADVICE}")
    return KittiOdometry(root, sequence)


def source(function: Callable[..., None], name: str | None = None) -> Callable[..., None]:
    """Make a function that opens a data set two commands: to map it, and to predict its windows."""
    command(function, name, options=MapOptions, verb="Map")
    command(function, name, group=predict_app, options=PredictOptions, verb="Predict")
    return function


@source
def demo(
    options: RunOptions,
    save_dataset: Annotated[
        Path | None,
        typer.Option(help="Only write the drive here, in KITTI's layout with depth maps."),
    ] = None,
) -> None:
    """A generated drive that comes back to its start, with the truth to score it against."""
    from laser_slam.datasets.synthetic.drive import SyntheticDrive

    config = options.settings()
    dataset = SyntheticDrive(config.synthetic)
    if save_dataset is None:
        options.work(dataset, config)
        return
    from laser_slam.datasets.synthetic.save import save_kitti_layout

    save_kitti_layout(dataset, save_dataset, "00")
    typer.echo(f"saved; map it with: laser-slam kitti 00 --root {save_dataset}")


@source
def kitti(
    sequence: Annotated[str, typer.Argument(metavar="SEQ", help="Such as 03.")],
    options: RunOptions,
    root: RootOption = None,
) -> None:
    """A sequence of KITTI odometry, scored where poses are there."""
    options.work(open_kitti(sequence, root), options.settings())


@functools.partial(source, name="7scenes")
def seven_scenes(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Such as redkitchen/seq-03.")],
    options: RunOptions,
) -> None:
    """A sequence of 7-Scenes, scored against its poses and depth."""
    from laser_slam.datasets.seven_scenes import SevenScenes

    options.work(SevenScenes(folder), options.settings())


@source
def images(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Or a pattern: 'DIR/*.png'.")],
    options: RunOptions,
    intrinsics: IntrinsicsOption = None,
    fov: FovOption = None,
) -> None:
    """The images of a folder, in natural order of their names."""
    from laser_slam.datasets.images import ImageFolder

    config = options.settings()
    dataset = ImageFolder(folder, _parse_intrinsics(intrinsics), fov, config.dataset.fps)
    options.work(dataset, config)


@source
def video(
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    options: RunOptions,
    intrinsics: IntrinsicsOption = None,
    fov: FovOption = None,
) -> None:
    """A video file."""
    from laser_slam.datasets.video import VideoFile

    config = options.settings()
    dataset = VideoFile(file, _parse_intrinsics(intrinsics), fov, config.dataset.stride)
    options.work(dataset, config)


def replay(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="What 'predict' wrote, or a run's folder.")
    ],
    options: MapOptions,
) -> None:
    """A sequence from its predictions alone: no images, no backbone; with other settings."""
    from laser_slam.predicting.sequence import PredictedSequence

    sequence = PredictedSequence(folder)
    if options.backbone is not None:
        raise ConfigError(f"--backbone {options.backbone}: these windows are predicted already")
    options.work(sequence, options.settings(sequence.settings))


command(replay, options=MapOptions, verb="Map")
app.add_typer(predict_app, name="predict")


def _parse_intrinsics(text: str | None) -> NDArray[np.float64] | None:
    from laser_slam.camera import intrinsics_matrix

    if text is None:
        return None
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--intrinsics wants fx,fy,cx,cy, got '{text}'") from error
    return intrinsics_matrix(fx, fy, cx, cy)
