"""The command that exports a finished run."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from laser_slam.cli.app import SetOption, command


class Photos(StrEnum):
    """Values of --images; those of ``PhotoKind``, without its imports."""

    original = "original"
    linked = "linked"
    undistorted = "undistorted"
    stored = "stored"


ToOption = Annotated[
    list[str] | None,
    typer.Option(
        "--to",
        help="Format; repeatable. Clouds: ply, pcd, xyz, xyz.gz, las, laz; surfaces: mesh-ply, "
        "mesh-glb; paths: kitti, tum, euroc, g2o; for Gaussian splatting: colmap, colmap-text, "
        "nerfstudio; depth maps: depth, depth-npz.",
    ),
]
PathOption = Annotated[
    Path | None,
    typer.Option(
        "--out", help="File or folder to be; of several formats, the folder for all. [RUN/export]"
    ),
]
ImagesOption = Annotated[
    Photos | None,
    typer.Option(
        "--images",
        help="Images for colmap and nerfstudio: copies of the originals, links to them, the "
        "originals without lens distortion, or the small ones that the run keeps.",
    ),
]
ImagesFromOption = Annotated[
    Path | None, typer.Option("--images-from", help="Where the original images or video are now.")
]
GeoreferenceOption = Annotated[
    Path | None,
    typer.Option(
        "--georeference",
        help="Places clouds: a 4x4 matrix to projected coordinates, or lines of time x y z.",
    ),
]
CrsOption = Annotated[
    str | None, typer.Option("--crs", help="Their coordinate system, such as EPSG:32632.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what is there.")]


@dataclass(frozen=True)
class ExportFlags:
    """Options of the command."""

    to: ToOption = None
    out: PathOption = None
    images: ImagesOption = None
    images_from: ImagesFromOption = None
    georeference: GeoreferenceOption = None
    crs: CrsOption = None
    force: ForceOption = False
    set: SetOption = None


@functools.partial(command, options=ExportFlags)
def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Such as runs/latest.")],
    options: ExportFlags,
) -> None:
    """Write a finished run in formats of other programs; nothing is predicted again."""
    from laser_slam.exporting import ExportOptions, PhotoKind, export_run

    chosen = ExportOptions(
        None if options.images is None else PhotoKind(options.images.value),
        options.images_from,
        options.georeference,
        options.crs,
        options.force,
        tuple(options.set or []),
    )
    for path in export_run(run, options.to or [], options.out, chosen):
        typer.echo(path)
