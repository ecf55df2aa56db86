"""What a person chooses of an export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class PhotoKind(StrEnum):
    """Which images go with a COLMAP model or a transforms.json."""

    ORIGINAL = "original"  # copies of the input, with the lens as it is
    LINKED = "linked"  # links to the input
    UNDISTORTED = "undistorted"  # the input as a pinhole camera would have taken it
    STORED = "stored"  # what the run itself keeps: undistorted, at the size of its depth maps


@dataclass(frozen=True)
class ExportOptions:
    """Choices of an export.

    Attributes:
        photos: which images go with it; None: the originals where the run knows its files, else
            the stored ones.
        photos_from: folder that the originals lie in now; None: where the run found them.
        georeference: file that places the world in a projected coordinate system; None: clouds
            stay in world units.
        crs: that system, such as ``EPSG:32632``; None: it is not named.
        force: replace what is there.
        assignments: ``section.key=value`` settings over those of the run.
    """

    photos: PhotoKind | None = None
    photos_from: Path | None = None
    georeference: Path | None = None
    crs: str | None = None
    force: bool = False
    assignments: Sequence[str] = ()
