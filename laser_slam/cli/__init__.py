"""The command line: one module for each kind of command, heavy imports inside the commands."""

from laser_slam.cli import (
    bench_command,
    dataset_sources,
    export_command,
    lidar_command,
    sources,
    stored,
    view_command,
)
from laser_slam.cli.app import app

__all__ = [
    "app",
    "bench_command",
    "dataset_sources",
    "export_command",
    "lidar_command",
    "main",
    "sources",
    "stored",
    "view_command",
]


def main() -> None:
    """Run the command line."""
    app(prog_name="laser-slam")
