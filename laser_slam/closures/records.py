"""What became of each candidate, in a file of the run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from laser_slam.errors import RunFolderError
from laser_slam.store.files import write_text

ACCEPTED = "accepted"


@dataclass(frozen=True)
class ClosureRecord:
    """One candidate: what was measured of it, and why it was accepted or not.

    Numbers are None where it did not come that far.

    Attributes:
        window_a: index of one window.
        window_b: index of the other.
        frame_a: the frame of a, in the sequence, that was taken for the place.
        frame_b: the frame of b.
        similarity: of the two frames' descriptors.
        image_inliers: matches of the two images that agree on one motion of the camera.
        image_pairs: pairs of neighbouring frames that match, that one included.
        inliers: matches with depth, of all pairs, that fit the similarity.
        residual: median absolute log-ratio of their depths.
        scale: units of window a per unit of window b.
        chain_scale: what the chain of registrations says of it.
        heading_deg: between the optical axes of the two frames.
        disagreement: between matches and loop window, in sigmas.
        covisible: share of the two clouds that both ends could see.
        overlap: share of that where both have a surface.
        cloud_residual: median distance of these surfaces, in median depths.
        source: what measured the closure: ``matches``, ``loop window`` or both.
        verdict: ``accepted``, or the reason against it in words.
    """

    window_a: int
    window_b: int
    frame_a: int
    frame_b: int
    similarity: float
    verdict: str
    image_inliers: int | None = None
    image_pairs: int | None = None
    inliers: int | None = None
    residual: float | None = None
    scale: float | None = None
    chain_scale: float | None = None
    heading_deg: float | None = None
    disagreement: float | None = None
    covisible: float | None = None
    overlap: float | None = None
    cloud_residual: float | None = None
    source: str | None = None

    @property
    def is_accepted(self) -> bool:
        """Tell whether the candidate is a closure."""
        return self.verdict == ACCEPTED


def write_closures(path: Path, records: Sequence[ClosureRecord]) -> None:
    """Write the records of all candidates as JSON, whole or not at all.

    Raises:
        RunFolderError: the system could not write.
    """
    lines = ",\n".join(json.dumps(asdict(record), allow_nan=False) for record in records)
    write_text(path, f"[\n{lines}\n]\n" if records else "[]\n")


def read_closures(path: Path) -> list[ClosureRecord]:
    """Read what ``write_closures`` wrote.

    Raises:
        RunFolderError: the file is missing or damaged.
    """
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        known = {field.name for field in fields(ClosureRecord)}
        return [
            ClosureRecord(**{name: row[name] for name in known & row.keys()}) for row in content
        ]
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise RunFolderError(
            f"cannot read closures {path}: {error}; delete it and run again"
        ) from error
