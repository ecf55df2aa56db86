"""Who has published a row: a number beside it, and the source below the table."""

from __future__ import annotations

from collections.abc import Sequence

from laser_slam.benchmarks.grid import Grid, Row


class Sources:
    """The sources of all blocks, numbered in their order.

    Args:
        grids: the blocks.
    """

    def __init__(self, grids: Sequence[Grid]) -> None:
        found = (row.source for grid in grids for row in grid.rows if row.source)
        self._numbers = {source: i for i, source in enumerate(dict.fromkeys(found), 1)}

    def name(self, row: Row) -> str:
        """Return a row's name, with the number of its source, or with what predicted."""
        if row.source:
            return f"{row.name} [{self._numbers[row.source]}]"
        return f"{row.name} ({row.backbone})" if row.backbone else row.name

    def lines(self) -> list[str]:
        """Return the sources by their numbers."""
        return [f"[{number}] {source}" for source, number in self._numbers.items()]
