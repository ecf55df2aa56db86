"""Intrinsics of own material: given, from the field of view, from EXIF, or unknown."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_from_fov, intrinsics_matrix
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

FOCAL_LENGTH_MM = 0x920A
FOCAL_LENGTH_35MM = 0xA405
PIXEL_WIDTH = 0xA002
PIXEL_HEIGHT = 0xA003
FOCAL_PLANE_X_RESOLUTION = 0xA20E
FOCAL_PLANE_UNIT = 0xA210
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF: inch, cm, mm, micrometre
DIAGONAL_35MM = math.hypot(36.0, 24.0)
PLAUSIBLE_FOCAL = (0.3, 10.0)  # in image diagonals; anything else in EXIF is a wrong entry
UNKNOWN = "unknown: neither --intrinsics nor --fov given{exif}; the backbone has to estimate them"


def check_intrinsics(intrinsics: Array, size: tuple[int, int], source: str) -> Array:
    """Refuse intrinsics that no image of (height, width) ``size`` can have.

    Raises:
        DatasetError: not (3, 3) and finite, focal lengths not positive, or the principal point
            outside the image; starts with ``source``, which says where they come from.
    """
    matrix = np.asarray(intrinsics, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise DatasetError(f"{source}: intrinsics must be a 3x3 matrix of finite numbers")
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    if min(fx, fy) <= 0:
        raise DatasetError(f"{source}: focal lengths must be positive, got fx={fx:g}, fy={fy:g}")
    height, width = size
    if not (0 <= cx <= width - 1 and 0 <= cy <= height - 1):
        raise DatasetError(
            f"{source}: the principal point cx={cx:g}, cy={cy:g} is outside the images of "
            f"{width}x{height} pixels; give intrinsics for this size"
        )
    return matrix


def choose_intrinsics(
    size: tuple[int, int],
    intrinsics: Array | None,
    fov_deg: float | None,
    exif: Mapping[int, object] | None = None,
) -> tuple[Array | None, str]:
    """Take the intrinsics that are given, or those of the field of view, or of the EXIF data.

    Args:
        size: (height, width) of the images, upright.
        intrinsics: (3, 3) in pixels; None: not given.
        fov_deg: horizontal field of view in degrees; None: not given.
        exif: entries of the first image by their tags; None: not the kind of file that has them.

    Returns:
        (3, 3) in pixels, or None where nothing is known, and where they come from in words.

    Raises:
        DatasetError: the given ones are impossible, or both are given.
    """
    if intrinsics is not None and fov_deg is not None:
        raise DatasetError("--intrinsics and --fov contradict each other; give one of them")
    if intrinsics is not None:
        return check_intrinsics(intrinsics, size, "--intrinsics"), "given by --intrinsics"
    if fov_deg is not None:
        if not 1 <= fov_deg <= 175:
            raise DatasetError(f"--fov must be between 1 and 175 degrees, got {fov_deg:g}")
        source = f"horizontal field of view of {fov_deg:g} degrees, given by --fov"
        return intrinsics_from_fov(fov_deg, *size), source
    if exif is None:
        return None, UNKNOWN.format(exif="")
    focal, source = _exif_focal(exif, size)
    if focal is None:
        return None, UNKNOWN.format(exif=" and no focal length in the EXIF data")
    return intrinsics_matrix(focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2), source


def _exif_focal(exif: Mapping[int, object], size: tuple[int, int]) -> tuple[float | None, str]:
    """Return the focal length in pixels, with its source; square pixels are assumed."""
    diagonal = math.hypot(*size)
    candidates = [
        # CIPA DCG-001: equal angle over the diagonal of 36 x 24 mm
        (_number(exif.get(FOCAL_LENGTH_35MM)) / DIAGONAL_35MM * diagonal, "35 mm equivalent"),
        (_focal_by_sensor(exif, max(size)), "focal length and sensor resolution"),
    ]
    for focal, what in candidates:
        if PLAUSIBLE_FOCAL[0] < focal / diagonal < PLAUSIBLE_FOCAL[1]:
            return focal, f"EXIF data of the first image ({what})"
    return None, ""


def _focal_by_sensor(exif: Mapping[int, object], longer_side: int) -> float:
    unit_mm = UNIT_MM.get(int(_number(exif.get(FOCAL_PLANE_UNIT, 2))), 0.0)
    if unit_mm == 0.0:
        return 0.0
    pixels_per_mm = _number(exif.get(FOCAL_PLANE_X_RESOLUTION)) / unit_mm
    taken = max(_number(exif.get(PIXEL_WIDTH)), _number(exif.get(PIXEL_HEIGHT)))
    shrunk = longer_side / (taken or longer_side)  # resized after it was taken
    return _number(exif.get(FOCAL_LENGTH_MM)) * pixels_per_mm * shrunk


def _number(value: object) -> float:
    """Read an EXIF entry, which may be missing or a broken fraction, as 0 then."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) else 0.0
