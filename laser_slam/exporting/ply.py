"""A run's map.ply, read in portions."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.types import Cloud

GREY = 128  # of points without colours
PORTION = 1 << 20  # points
MAX_HEADER = 1 << 16  # bytes

_TYPES = {"float": "<f4", "double": "<f8", "uchar": "|u1"}

logger = logging.getLogger(__name__)


def read_ply(path: Path, voxel_size: float) -> Iterator[Cloud]:
    """Read a cloud with whatever it has of colours, normals and weights.

    Args:
        path: a binary PLY file such as laser-slam writes.
        voxel_size: about the distance between its points.

    Raises:
        RunFolderError: the file is missing, cut short or something else.
    """
    try:
        layout, num, start = _header(path)
        if path.stat().st_size != start + num * layout.itemsize:
            raise ValueError("its length")
        names = layout.names or ()
        if not set("xyz") <= set(names):
            raise ValueError("no positions")
    except FileNotFoundError as error:
        raise RunFolderError(f"{path} is missing; run again") from error
    except (OSError, ValueError, KeyError) as error:
        raise RunFolderError(f"{path} is damaged; run again") from error
    if "red" not in names:
        logger.warning("%s has no colours: its points become grey", path)
    for first in range(0, num, PORTION):
        count = min(PORTION, num - first)
        rows = np.fromfile(path, layout, count, offset=start + first * layout.itemsize)
        yield _cloud(rows, names, voxel_size)


def _header(path: Path) -> tuple[np.dtype[Any], int, int]:
    """Return the layout of a point, how many there are, and where they begin."""
    with path.open("rb") as file:
        data = file.read(MAX_HEADER)
    head, mark, _ = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    if not mark or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise ValueError("no binary PLY")
    (num,) = [int(line[2]) for line in lines if line[:2] == ["element", "vertex"]]
    columns = [(line[2], _TYPES[line[1]]) for line in lines if line[0] == "property"]
    return np.dtype(columns), num, len(head) + len(mark)


def _cloud(rows: NDArray[Any], names: Sequence[str], voxel_size: float) -> Cloud:
    colors = np.full((len(rows), 3), GREY, np.uint8)
    if "red" in names:
        colors = _columns(rows, ("red", "green", "blue")).astype(np.uint8)
    weights = np.ones(len(rows), np.float32)
    if "weight" in names:
        weights = rows["weight"].astype(np.float32)
    normals = None
    if "nx" in names:
        normals = _columns(rows, ("nx", "ny", "nz")).astype(np.float32)
    points = _columns(rows, ("x", "y", "z")).astype(np.float64)
    return Cloud(points, colors, weights, voxel_size, normals)


def _columns(rows: NDArray[Any], names: Sequence[str]) -> NDArray[Any]:
    return np.stack([rows[name] for name in names], axis=1)
