"""Export a finished run: read its folder, let the stage write."""

from laser_slam.exporting.job import export_run
from laser_slam.exporting.options import ExportOptions, PhotoKind

__all__ = ["ExportOptions", "PhotoKind", "export_run"]
