"""The rows to run: a name, and the settings in which they differ."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from laser_slam.benchmarks.table import Table
from laser_slam.errors import ConfigError

NAME = re.compile(r"[^\x00-\x1f]+")
_NEXT = re.compile(r",(?=\s*[A-Za-z_][\w.]*=)")  # a comma inside a value is part of it


@dataclass(frozen=True)
class Setting:
    """A row: its name, and its ``section.key=value`` assignments."""

    name: str
    assignments: tuple[str, ...] = ()

    @property
    def folder(self) -> str:
        """Return a name for its folder that every file system takes."""
        return re.sub(r"[^\w.+-]+", "-", self.name).strip("-.") or "row"


def parse_settings(given: Sequence[str], table: Table) -> list[Setting]:
    """Read ``NAME=key=value,key=value``, or names of rows or row groups; none: all rows.

    Raises:
        ConfigError: a name is missing, given twice, or alone and neither of a row nor of a group.

    >>> from laser_slam.benchmarks.table import load_table
    >>> parse_settings(["short=windows.size=10,windows.overlap=3"], load_table("kitti"))
    [Setting(name='short', assignments=('windows.size=10', 'windows.overlap=3'))]
    """
    every = [Setting(name, assignments) for name, assignments in table.rows.items()]
    asked = [setting for text in given for setting in _parse(text, table)]
    settings = list(dict.fromkeys(asked if given else every))  # a row may be in several groups
    folders = [setting.folder for setting in settings]
    for setting in settings:
        if folders.count(setting.folder) > 1:
            raise ConfigError(
                f"the row '{setting.name}' is given twice, or shares the folder {setting.folder} "
                "with another; name it otherwise"
            )
    return settings


def _parse(text: str, table: Table) -> list[Setting]:
    name, equals, rest = (part.strip() for part in text.partition("="))
    names = table.row_groups.get(name, (name,) if name in table.rows else ())
    if not equals and names:
        return [Setting(row, table.rows[row]) for row in names]
    if not equals or not NAME.fullmatch(name):
        rows = ", ".join([*table.row_groups, *table.rows])
        raise ConfigError(
            f"--setting wants NAME=section.key=value,... or a row of the table ({rows}), "
            f"got '{text}'"
        )
    return [Setting(name, tuple(part.strip() for part in _NEXT.split(rest) if part.strip()))]
