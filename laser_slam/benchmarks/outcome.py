"""What became of one row on one sequence."""

from __future__ import annotations

from dataclasses import dataclass, field

from laser_slam.benchmarks.measures import Scores

NOT_YET = "not run yet"


@dataclass(frozen=True)
class Outcome:
    """What became of one row on one sequence.

    Attributes:
        setting: name of the row.
        sequence: its name in the table.
        scores: results by protocol; empty: it was not run.
        reason: why there are none; None: there are.
        part: which part of the sequence was there; None: the whole, or nobody knows.
        backbone: that predicts, or would have.
    """

    setting: str
    sequence: str
    scores: Scores = field(default_factory=dict)
    reason: str | None = None
    part: str | None = None
    backbone: str = ""
