"""A page of results that only this program writes: a section for each table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from laser_slam import __version__
from laser_slam.benchmarks.grid import Grid, fill_grids
from laser_slam.benchmarks.printing import as_csv, as_markdown
from laser_slam.benchmarks.runner import Outcome
from laser_slam.benchmarks.settings import Setting
from laser_slam.benchmarks.table import Table
from laser_slam.errors import RunFolderError
from laser_slam.store import write_text

HEAD = """# Results as they stand

Written by `laser-slam bench`, each table by the command that stands in it; no number by hand.

```
laser-slam bench TABLE --data DATA    # here, kitti, depth, pose, points, waymo, ablation
laser-slam bench TABLE --data DATA --backbone pi3
laser-slam bench TABLE --share --setting ours --setting short=windows.size=10,windows.overlap=3
laser-slam bench TABLE --only 03,06 --page docs/results.md
```

DATA holds the data sets as [datasets.md](datasets.md) describes them, each in a folder of its own
(`kitti_odometry`, `7scenes`, `sintel`, `bonn`, `tum`, `scannet`, `nrgbd`, `waymo`, `kitti_depth`)
or all in one. A row is a setting: its own `section.key=value` over those that all rows have. Each
row of each sequence is a run with a folder of its own below `--out`; the same command goes on where
it stopped and runs nothing twice. `--share` predicts windows once for all rows that cut the same;
the backbone is then not asked about loops. `preset=vggt-long` in a row is VGGT-Long's registration
and loops on the same backbone (the paper's "pi3-Long"), `preset=paper` and `preset=official` are
the choices of the LASER paper and of its code.

Rows whose source is "this run" were run by the command, all others are as their source has
published them. A mean says over how many sequences it is where some have no number; a number with *
is over a part of a sequence, and in no mean. Why, stands below the table.
"""


@dataclass(frozen=True)
class Report:
    """A table that was run.

    Attributes:
        name: of the table.
        table: itself.
        settings: the rows that were run.
        outcomes: what became of them.
        command: that makes it again.
    """

    name: str
    table: Table
    settings: Sequence[Setting]
    outcomes: Sequence[Outcome]
    command: str

    def section(self, grids: Sequence[Grid]) -> str:
        """Write the table as a section of a page."""
        rows = [
            f"- **{setting.name}**: `{' '.join(setting.assignments) or 'no setting of its own'}`"
            for setting in self.settings
        ]
        notes = [
            f"- {name}: {spec.note}" for name, spec in self.table.sequences.items() if spec.note
        ]
        common = " ".join(self.table.settings)
        return "\n\n".join(
            [
                f"## {self.table.title}",
                *([self.table.about.strip()] if self.table.about else []),
                f"```\n{self.command}\n```",
                f"By laser-slam {__version__}."
                + (f" Settings of all rows: `{common}`." if common else ""),
                "\n".join(rows),
                *(["\n".join(notes)] if notes else []),
                as_markdown(grids, self.outcomes),
            ]
        )


def save_table(out: Path, report: Report, page: Path | None = None) -> list[Path]:
    """Write a table as Markdown and CSV, and on a page of results where there is one.

    Args:
        out: folder of the table's runs.
        report: what was run.
        page: Markdown file whose section of the table is renewed; None: there is none.

    Returns:
        The files.

    Raises:
        RunFolderError: one cannot be written.
    """
    grids = fill_grids(report.table, report.outcomes)
    section = report.section(grids)
    out.mkdir(parents=True, exist_ok=True)
    files = [out / f"{report.name}.md", out / f"{report.name}.csv"]
    write_text(files[0], section.rstrip() + "\n")
    write_text(files[1], as_csv(report.name, grids))
    if page is not None:
        put_on_page(page, report.name, section)
        files.append(page)
    return files


def put_on_page(page: Path, name: str, section: str) -> None:
    """Write a table's section, in the place of the one that the page has of it.

    Args:
        page: Markdown file; made where there is none.
        name: of the table.
        section: Markdown.

    Raises:
        RunFolderError: the page cannot be read or written.
    """
    start, end = f"<!-- bench {name} -->", f"<!-- end of bench {name} -->"
    try:
        text = page.read_text(encoding="utf-8") if page.exists() else HEAD
    except (OSError, UnicodeDecodeError) as error:
        raise RunFolderError(f"cannot read {page}: {error}") from error
    whole = f"{start}\n{section.strip()}\n{end}"
    found = re.search(f"{re.escape(start)}.*?{re.escape(end)}", text, re.DOTALL)
    if found is None:
        text = f"{text.rstrip()}\n\n{whole}\n"
    else:
        text = text[: found.start()] + whole + text[found.end() :]
    page.parent.mkdir(parents=True, exist_ok=True)
    write_text(page, text)
