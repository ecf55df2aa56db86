"""Clouds as LAS and LAZ, in portions, by laspy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from laser_slam.dependencies import import_laspy
from laser_slam.errors import ConfigError
from laser_slam.export.base import Points, Source
from laser_slam.store import atomic_write
from laser_slam.types import Cloud

_COARSEST = 1e-3  # of a unit: the millimetre of a map in metres
_FINENESS = 0.01  # of a voxel
_STEPS = 2.0**31 - 2**10  # that a coordinate of 32 bits has on either side of the offset
_WIDE = 65535 // 255  # from 8 bits of colour to 16


def export_las(path: Path, source: Source) -> None:
    """Write the map as LAS 1.4, point format 7: coordinates in steps, colours of 16 bits, weights.

    The steps are a power of ten, at most 1/1000 of a unit and about 1/100 of a voxel; the offset
    is the middle of the map. Normals, where there are, and weights are extra dimensions.

    Raises:
        RunFolderError: the map is empty, or the file cannot be written.
        DependencyError: laspy is not installed.
        ConfigError: the coordinate system is unknown, or not projected.
    """
    _write(path, source.some_points(), compress=False)


def export_laz(path: Path, source: Source) -> None:
    """Write the map compressed; see ``export_las``.

    Raises:
        RunFolderError: the map is empty, or the file cannot be written.
        DependencyError: laspy or lazrs is not installed.
        ConfigError: the coordinate system is unknown, or not projected.
    """
    _write(path, source.some_points(), compress=True)


def _write(path: Path, points: Points, *, compress: bool) -> None:
    laspy = import_laspy()
    header = _header(laspy, points)
    with (
        atomic_write(path) as partial,
        partial.open("wb") as file,
        laspy.open(file, mode="w", header=header, do_compress=compress, closefd=False) as writer,
    ):
        for cloud in points.portions():
            if len(cloud.points):
                writer.write_points(_record(laspy, header, cloud))


def _header(laspy: Any, points: Points) -> Any:
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.generating_software = "laser-slam"
    header.offsets = np.round((points.low + points.high) / 2)
    header.scales = np.full(3, _step(points))
    names = ["weight", *(["normal_x", "normal_y", "normal_z"] if points.has_normals else [])]
    header.add_extra_dims([laspy.ExtraBytesParams(name, "f4") for name in names])
    if points.crs is not None:
        header.add_crs(parse_crs(points.crs))
    return header


def _step(points: Points) -> float:
    """Return the finest step that is wanted, or the finest that 32 bits can reach over the map."""
    wanted = min(_COARSEST, _FINENESS * points.voxel_size or _COARSEST)
    reach = float(np.max(points.high - points.low)) / 2 + 1
    exponent = max(np.floor(np.log10(wanted)), np.ceil(np.log10(reach / _STEPS)))
    return float(10.0**exponent)


def parse_crs(name: str) -> Any:
    """Find a projected coordinate system: one whose coordinates are lengths, as the map's are.

    Raises:
        ConfigError: there is no such one, or it is not projected.
        DependencyError: pyproj is not installed.
    """
    import_laspy()
    import pyproj  # noqa: PLC0415  (an extra)

    try:
        crs = pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError as error:
        raise ConfigError(
            f"no coordinate system '{name}'; name one such as EPSG:32632 (UTM zone 32 north)"
        ) from error
    if not crs.is_projected:
        raise ConfigError(
            f"the coordinate system '{name}' ({crs.name}) is not projected; name one whose "
            "coordinates are lengths, such as EPSG:32632 (UTM zone 32 north)"
        )
    return crs


def _record(laspy: Any, header: Any, cloud: Cloud) -> Any:
    record = laspy.ScaleAwarePointRecord.zeros(len(cloud.points), header=header)
    record.x, record.y, record.z = cloud.points.T
    record.red, record.green, record.blue = (cloud.colors.astype(np.uint16) * _WIDE).T
    record.return_number = np.ones(len(cloud.points), np.uint8)
    record.number_of_returns = np.ones(len(cloud.points), np.uint8)
    record["weight"] = cloud.weights
    if cloud.normals is not None and "normal_x" in record.point_format.dimension_names:
        record["normal_x"], record["normal_y"], record["normal_z"] = cloud.normals.T
    return record
