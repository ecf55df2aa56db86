"""A page of results that only this program writes: a section for each table."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from laser_slam import __version__
from laser_slam.benchmarks.grid import Grid, fill_grids
from laser_slam.benchmarks.notes import name_groups
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.settings import Setting
from laser_slam.benchmarks.table import Table
from laser_slam.benchmarks.written import as_csv, as_markdown
from laser_slam.errors import RunFolderError
from laser_slam.store.files import make_folder, write_text

HEAD = """# Results as they stand

Written by `laser-slam bench`, each table by the command that stands in it; no number by hand.

```
laser-slam bench                            # lists the tables
laser-slam bench kitti --data DATA --list   # its rows and sequences, and which of them are there
laser-slam bench kitti --data DATA          # runs them and prints the table; goes on if broken off
laser-slam bench kitti --data DATA --only 03,06 --backbone pi3 --page docs/results.md
laser-slam bench here --share --setting ours --setting short=windows.size=10,windows.overlap=3
laser-slam bench my-table.yaml --data DATA  # a table as those in laser_slam/benchmarks/tables
```

DATA holds the data sets as [datasets.md](datasets.md) describes them, each in a folder of its own
(`kitti_odometry`, `7scenes`, `sintel`, `bonn`, `tum`, `scannet`, `nrgbd`, `waymo`, `kitti_depth`)
or all in one. A row is a setting: its own `section.key=value` over those that all rows have. Each
row of each sequence is a run with a folder of its own below `--out`, and no run is made twice.
`--share` predicts windows once for all rows that cut the same; the backbone is then not asked about
loops. `--lean` keeps scores, paths and report of each run, and neither windows nor map.
`preset=vggt-long` in a row is VGGT-Long's registration and loops on the same backbone (the paper's
"pi3-Long"), `preset=paper` and `preset=official` are the choices of LASER's paper and of its code.

Rows in bold were run by the command, with the backbone in brackets; all others are as the source
with that number has published them. The best number of a column is bold. A mean says over how many
sequences it is where some have no number; a number with * is over a part of a sequence, and in no
mean. The notes say why. The CSV file in `--out` has every number, also of each sequence of a mean.
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
        common = " ".join(self.table.settings)
        parts = [
            f"## {self.table.title}",
            self.table.about.strip(),
            f"```\n{self.command}\n```",
            f"By laser-slam {__version__}."
            + (f" Settings of all rows: `{common}`." if common else ""),
            "\n".join(self._rows()),
            "\n".join(self._sequences()),
            as_markdown(self.table, grids, self.outcomes),
        ]
        return "\n\n".join(part for part in parts if part)

    def _rows(self) -> Iterator[str]:
        for setting in self.settings:
            own = f"`{' '.join(setting.assignments)}`" if setting.assignments else "as all rows are"
            yield f"- **{setting.name}**: {own}"

    def _sequences(self) -> Iterator[str]:
        """Tell of the sequences that were asked for what is to know, once where it is the same."""
        asked = {outcome.sequence for outcome in self.outcomes}
        told: dict[tuple[str, tuple[str, ...]], list[str]] = {}
        for name, spec in self.table.sequences.items():
            if name in asked and (spec.note or spec.settings):
                told.setdefault((spec.note, spec.settings), []).append(name)
        for (note, settings), names in told.items():
            with_these = f"`{' '.join(settings)}`" if settings else ""
            what = "; ".join(part for part in (note, with_these) if part)
            yield f"- {', '.join(name_groups(names, self.table.groups))}: {what}"


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
    make_folder(out)
    files = [out / f"{report.name}.md", out / f"{report.name}.csv"]
    write_text(files[0], section.rstrip() + "\n")
    write_text(files[1], as_csv(report.name, grids))
    if page is not None:
        put_on_page(page, report.name, section)
        files.append(page)
    return files


def put_on_page(page: Path, name: str, section: str) -> None:
    """Write a table's section, in the place of the one that the page has of it.

    What stands before the first table is renewed where this program wrote it.

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
    if text.startswith(HEAD[: HEAD.index(",")]):
        _, mark, tables = text.partition("\n<!-- bench ")
        text = HEAD + mark + tables
    whole = f"{start}\n{section.strip()}\n{end}"
    found = re.search(f"{re.escape(start)}.*?{re.escape(end)}", text, re.DOTALL)
    if found is None:
        text = f"{text.rstrip()}\n\n{whole}\n"
    else:
        text = text[: found.start()] + whole + text[found.end() :]
    make_folder(page.parent)
    write_text(page, text)
