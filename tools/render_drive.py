"""Write a synthetic drive in KITTI odometry's layout, with depth maps.

python tools/render_drive.py OUT                       a loop around a block
python tools/render_drive.py OUT --poses poses/00.txt  a city along a given trajectory
python tools/render_drive.py OUT --set synthetic.num_frames=1200 --set synthetic.seed=3
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from laser_slam.config import load_config
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.save import save_kitti_layout
from laser_slam.errors import LaserSlamError


def main(
    out: Annotated[Path, typer.Argument(help="root folder; gets 'sequences' and 'poses'")],
    sequence: Annotated[str, typer.Option(help="name of the sequence")] = "00",
    poses: Annotated[Path | None, typer.Option(help="drive along this KITTI poses file")] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", help="setting, such as synthetic.seed=3")
    ] = None,
) -> None:
    """Render a drive and write it."""
    try:
        config = load_config(assignments=assignments or []).synthetic
        drive = SyntheticDrive.from_poses_file(poses, config) if poses else SyntheticDrive(config)
        with Progress() as progress:
            task = progress.add_task("rendering", total=drive.info.num_frames)
            save_kitti_layout(drive, out, sequence, lambda _: progress.advance(task))
    except LaserSlamError as error:
        typer.echo(f"render_drive: {error}", err=True)
        raise typer.Exit(1) from error


if __name__ == "__main__":
    typer.run(main)
