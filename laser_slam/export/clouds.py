"""Clouds as PLY, PCD and text, written in portions."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from laser_slam.export.base import Points, Source, survey
from laser_slam.store import atomic_write
from laser_slam.types import Cloud

_LOSSLESS = 0.01  # of a voxel: rounding below this is not seen
_ROWS = 1 << 18  # of a portion of text
_NORMALS = ("nx", "ny", "nz")
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar"}


def write_ply(path: Path, cloud: Cloud | Callable[[], Iterator[Cloud]]) -> None:
    """Write a cloud, or what reads its parts, as binary PLY: positions, colours, weights.

    Positions are in world units, float32 where rounding moves no point by more than a hundredth
    of a voxel, else float64: no offset is taken off, so that every reader sees world coordinates.
    The weight of a point is its property ``weight`` (float32). Normals, where there are, are
    float32.

    Raises:
        RunFolderError: the folder is missing, cannot be written or is full.
    """
    _write_ply(path, survey(cloud if callable(cloud) else lambda: iter([cloud])))


def export_ply(path: Path, source: Source) -> None:
    """Write the map as binary PLY; see ``write_ply``.

    Raises:
        RunFolderError: the map is empty, or the file cannot be written.
    """
    _write_ply(path, source.some_points())


def export_pcd(path: Path, source: Source) -> None:
    """Write the map as binary PCD 0.7: x y z, normals, colours packed as PCL does, weight.

    Raises:
        RunFolderError: the map is empty, or the file cannot be written.
    """
    points = source.some_points()
    columns = [*_geometry(points, "normal_"), ("rgb", "<u4"), ("weight", "<f4")]
    kinds = [kind[1:] for _, kind in columns]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _ in columns),
        "SIZE " + " ".join(kind[1] for kind in kinds),
        "TYPE " + " ".join(kind[0].upper() for kind in kinds),
        "COUNT " + " ".join("1" for _ in columns),
        f"WIDTH {points.num}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points.num}",
        "DATA binary",
    ]
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        for cloud in points.portions():
            rows = _rows(cloud, columns)
            red, green, blue = cloud.colors.astype(np.uint32).T
            rows["rgb"] = red << 16 | green << 8 | blue
            file.write(rows.tobytes())


def export_xyz(path: Path, source: Source) -> None:
    """Write the map as text: ``x y z red green blue`` (0 to 255) a point, then its normal if any.

    Raises:
        RunFolderError: the map is empty, or the file cannot be written.
    """
    points = source.some_points()
    with atomic_write(path) as partial, partial.open("wb") as file:
        _write_text(file, points)


def export_xyz_gz(path: Path, source: Source) -> None:
    """Write the map as compressed text; see ``export_xyz``.

    Raises:
        RunFolderError: the map is empty, or the file cannot be written.
    """
    points = source.some_points()
    with (
        atomic_write(path) as partial,
        partial.open("wb") as file,
        gzip.GzipFile("", "wb", 6, file, mtime=0) as packed,
    ):
        _write_text(cast(IO[bytes], packed), points)


def _write_ply(path: Path, points: Points) -> None:
    columns = [
        *_geometry(points, "n"),
        *((name, "|u1") for name in ("red", "green", "blue")),
        ("weight", "<f4"),
    ]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {points.num}"]
    lines += [f"property {_PLY_TYPES[kind[1:]]} {name}" for name, kind in columns]
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
        for cloud in points.portions():
            rows = _rows(cloud, columns)
            for i, name in enumerate(("red", "green", "blue")):
                rows[name] = cloud.colors[:, i]
            file.write(rows.tobytes())


def _geometry(points: Points, prefix: str) -> list[tuple[str, str]]:
    """Name the columns of positions and normals, with their types."""
    columns = [(axis, _position_type(points)) for axis in "xyz"]
    if points.has_normals:
        columns += [(prefix + axis, "<f4") for axis in "xyz"]
    return columns


def _rows(cloud: Cloud, columns: list[tuple[str, str]]) -> NDArray[Any]:
    """Fill a table with positions, normals and weights; colours are the caller's."""
    rows = np.zeros(len(cloud.points), np.dtype(columns))
    for i, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, i]
    rows["weight"] = cloud.weights
    names = [name for name, _ in columns[3:6]]
    if cloud.normals is not None and names[0] in {"nx", "normal_x"}:
        for i, name in enumerate(names):
            rows[name] = cloud.normals[:, i]
    return rows


def _position_type(points: Points) -> str:
    if not points.num:
        return "<f4"
    furthest = np.float32(max(np.abs(points.low).max(), np.abs(points.high).max()))
    rounding = float(np.spacing(furthest)) / 2
    return "<f4" if rounding <= _LOSSLESS * points.voxel_size else "<f8"


def _write_text(file: IO[bytes], points: Points) -> None:
    decimals = 6
    if points.voxel_size > 0:
        decimals = max(0, int(np.ceil(-np.log10(_LOSSLESS * points.voxel_size))))
    style = " ".join([f"%.{decimals}f"] * 3 + ["%d"] * 3 + ["%.4f"] * 3 * points.has_normals)
    for cloud in points.portions():
        for part in _slices(len(cloud.points)):
            columns: list[NDArray[Any]] = [cloud.points[part], cloud.colors[part]]
            if points.has_normals and cloud.normals is not None:
                columns.append(cloud.normals[part])
            text = io.BytesIO()
            np.savetxt(text, np.hstack(columns), fmt=style)
            file.write(text.getvalue())


def _slices(num: int) -> Iterator[slice]:
    for start in range(0, num, _ROWS):
        yield slice(start, start + _ROWS)
