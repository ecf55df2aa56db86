"""How long the rest of a table will take, from what it took so far."""

from __future__ import annotations

from collections.abc import Hashable, Mapping


class Pace:
    """Runs that are to be made, and how long those took that were.

    Args:
        frames: of each run; 0: not known.
    """

    def __init__(self, frames: Mapping[Hashable, int]) -> None:
        known = [num for num in frames.values() if num]
        usual = sum(known) / len(known) if known else 1.0
        self._left = {run: float(num or usual) for run, num in frames.items()}
        self._done = self._seconds = 0.0

    def note(self, run: Hashable, seconds: float) -> None:
        """Note that a run is finished, and how long it took."""
        self._done += self._left.pop(run, 0.0)
        self._seconds += seconds

    def drop(self, run: Hashable) -> None:
        """Note that a run is not made."""
        self._left.pop(run, None)

    @property
    def num_left(self) -> int:
        """Count the runs that are still to be made."""
        return len(self._left)

    def left(self) -> str:
        """Say how many runs are left, and about how long they will take.

        >>> pace = Pace({"a": 100, "b": 300})
        >>> pace.note("a", 60.0)
        >>> pace.left()
        '1 run to go, about 3 min'
        """
        runs = f"{self.num_left} run{'' if self.num_left == 1 else 's'} to go"
        if not self._done or not self.num_left:
            return runs
        return f"{runs}, about {in_words(self._seconds / self._done * sum(self._left.values()))}"


def in_words(seconds: float) -> str:
    """Write a time as a person would.

    >>> in_words(42), in_words(600), in_words(9000)
    ('42 s', '10 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
