"""Means over the sequences of a table, which say over how many they are and what they lack.

A sequence that failed stays a row; it counts for no mean, and every mean names what it lacks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class SequenceScores:
    """The scores of one sequence, or why it has none.

    Attributes:
        name: of the sequence.
        scores: by name; None: the data do not determine it.
        weight: in a weighted mean, such as the number of pixels with truth.
        reason: why there are no scores; None: there are.
    """

    name: str
    scores: Mapping[str, float | None]
    weight: float = 1.0
    reason: str | None = None


@dataclass(frozen=True)
class Mean:
    """A mean over sequences, and over which.

    Attributes:
        value: None: no sequence has the score.
        num: how many sequences it is over.
        missing: the sequences that should be in it and have no such score.
    """

    value: float | None
    num: int
    missing: tuple[str, ...]

    @property
    def num_sequences(self) -> int:
        """Say how many sequences should be in it."""
        return self.num + len(self.missing)


def failed_sequence(name: str, reason: str) -> SequenceScores:
    """Make the row of a sequence that could not be run or scored."""
    return SequenceScores(name, {}, reason=reason)


def mean_score(rows: Sequence[SequenceScores], score: str, *, is_weighted: bool = False) -> Mean:
    """Average one score over the sequences that have it.

    Args:
        rows: all sequences that the mean should be over, the failed ones too.
        score: its name.
        is_weighted: True weights each sequence, as video depth does with its pixels.

    >>> rows = [SequenceScores("00", {"ate_m": 6.0}), failed_sequence("01", "tracking lost")]
    >>> mean_score(rows, "ate_m")
    Mean(value=6.0, num=1, missing=('01',))
    """
    found = [(row, value) for row in rows if (value := row.scores.get(score)) is not None]
    missing = tuple(row.name for row in rows if row.scores.get(score) is None)
    weights = [row.weight if is_weighted else 1.0 for row, _ in found]
    if not sum(weights):
        return Mean(None, 0, tuple(row.name for row in rows))
    total = sum(weight * value for weight, (_, value) in zip(weights, found, strict=True))
    return Mean(total / sum(weights), len(found), missing)
