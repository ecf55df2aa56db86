"""The commands that open a published data set of RGB-D, film or LiDAR images."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated

import typer

from laser_slam.cli.app import RunOptions
from laser_slam.cli.sources import source


def _folder(example: str) -> typer.models.ArgumentInfo:
    argument: typer.models.ArgumentInfo = typer.Argument(metavar="DIR", help=f"Such as {example}.")
    return argument


RectifyOption = Annotated[
    bool,
    typer.Option(
        "--rectify",
        help="Take the published lens distortion out, of images and depth. Published "
        "evaluations leave it in.",
    ),
]


@functools.partial(source, name="tum-rgbd")
def tum_rgbd(
    folder: Annotated[Path, _folder("rgbd_dataset_freiburg1_desk, or the rgb_90 in it")],
    options: RunOptions,
    rectify: RectifyOption = False,
) -> None:
    """A sequence of TUM RGB-D, scored against its poses and depth."""
    from laser_slam.datasets.tum_rgbd import TumRgbd

    options.work(TumRgbd(folder, rectify=rectify), options.settings())


@source
def bonn(
    folder: Annotated[Path, _folder("rgbd_bonn_balloon2, or the rgb_110 in it")],
    options: RunOptions,
    by_rank: Annotated[
        bool,
        typer.Option(
            "--by-rank",
            help="Pair images and depth maps by their order, not by time, as published "
            "evaluations do.",
        ),
    ] = False,
    rectify: RectifyOption = False,
) -> None:
    """A sequence of Bonn RGB-D Dynamic, scored against its poses and depth."""
    from laser_slam.datasets.bonn import Bonn

    options.work(Bonn(folder, by_rank=by_rank, rectify=rectify), options.settings())


@source
def scannet(
    folder: Annotated[Path, _folder("scene0707_00, or the color_90 in it")], options: RunOptions
) -> None:
    """A scene of ScanNet, exported from its .sens file, scored against its poses and depth."""
    from laser_slam.datasets.scannet import ScanNet

    options.work(ScanNet(folder), options.settings())


@source
def sintel(folder: Annotated[Path, _folder("training/final/alley_2")], options: RunOptions) -> None:
    """A sequence of MPI Sintel, scored against its cameras and depth."""
    from laser_slam.datasets.sintel import Sintel

    options.work(Sintel(folder), options.settings())


@source
def nrgbd(folder: Annotated[Path, _folder("breakfast_room")], options: RunOptions) -> None:
    """A scene of NRGBD, scored against its poses and depth."""
    from laser_slam.datasets.nrgbd import Nrgbd

    options.work(Nrgbd(folder), options.settings())


@source
def waymo(
    folder: Annotated[Path, _folder("segment-..._with_camera_labels.tfrecord, converted")],
    options: RunOptions,
    camera: Annotated[int, typer.Option(help="1 to 5; 1: front.")] = 1,
    rectify: RectifyOption = False,
) -> None:
    """A converted segment of the Waymo Open Dataset, scored against its poses and LiDAR."""
    from laser_slam.datasets.waymo import Waymo

    options.work(Waymo(folder, camera=camera, rectify=rectify), options.settings())


@functools.partial(source, name="kitti-depth")
def kitti_depth(
    folder: Annotated[Path, _folder("val/2011_09_26_drive_0002_sync")],
    options: RunOptions,
    raw: Annotated[
        Path | None, typer.Option(help="Folder of the raw drives, where they lie elsewhere.")
    ] = None,
) -> None:
    """A drive of KITTI's annotated depth, scored against it."""
    from laser_slam.datasets.kitti_depth import KittiDepth

    options.work(KittiDepth(folder, raw=raw), options.settings())
