"""The page of a run: report.html, made from the run's folder alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from laser_slam import __version__
from laser_slam.errors import RunFolderError
from laser_slam.report.html import Page, render_page
from laser_slam.results.page.loops import loops
from laser_slam.results.page.paths import depths, trajectory, world_map
from laser_slam.results.page.reading import Report, look
from laser_slam.results.page.run import details, facts, group_warnings, settings, time_by_stage
from laser_slam.results.page.scores import accuracy, headline
from laser_slam.results.page.windows import windows
from laser_slam.store import write_text


def write_report_page(folder: Path) -> None:
    """Write ``report.html`` from ``report.json`` and the pictures of a run.

    What an older report lacks is left out, or said to be unknown.

    Args:
        folder: of a finished run.

    Raises:
        RunFolderError: no finished run is there, or the page cannot be written.
    """
    report = read_report(folder)
    page = Page(
        title=str(look(report, "sequence.name") or folder.resolve().name),
        facts=facts(report),
        headline=headline(report),
        warnings=group_warnings(report),
        sections=[
            world_map(report, folder),
            trajectory(report, folder),
            accuracy(report),
            windows(report, folder),
            loops(report, folder),
            depths(folder),
            time_by_stage(report),
            settings(report),
            details(report, folder),
        ],
        footer=f"laser-slam {__version__} · the same numbers for machines: report.json",
    )
    write_text(folder / "report.html", render_page(page))


def read_report(folder: Path) -> Report:
    """Read ``report.json`` of a run.

    Raises:
        RunFolderError: it is missing or damaged.
    """
    path = folder / "report.json"
    try:
        report: Any = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RunFolderError(
            f"no finished run in {folder}; give a run folder, such as runs/latest"
        ) from error
    except ValueError as error:
        raise RunFolderError(f"{path} is damaged: {error}") from error
    if not isinstance(report, dict):
        raise RunFolderError(f"{path} is no report of a run")
    return report
