"""KITTI's calibration files: rows of a name, a colon and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.intrinsics import check_intrinsics
from laser_slam.datasets.kitti_dates import DAYS
from laser_slam.datasets.velodyne import Rig
from laser_slam.errors import DatasetError
from laser_slam.sim3 import orthonormal

Array = NDArray[np.float64]

MAX_SKEW = 1e-3  # how far a rotation may be from one


def read_rows(path: Path, advice: str) -> dict[str, Array]:
    """Read the rows of a file that hold numbers, by their names.

    Args:
        path: of the file.
        advice: what to do where it cannot be read.

    Raises:
        DatasetError: the file is missing or no text.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DatasetError(f"cannot read {path} ({error.strerror}); {advice}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is not a text file; {advice}") from error
    rows = {}
    for line in text.splitlines():
        name, _, values = line.partition(":")
        try:
            rows[name.strip()] = np.array([float(value) for value in values.split()])
        except ValueError:
            continue  # a date
    return rows


def odometry_rig(path: Path, camera: str, size: tuple[int, int], advice: str) -> Rig:
    """Read rows ``P<camera>`` and ``Tr`` of a ``calib.txt`` of KITTI odometry.

    Args:
        path: of the file.
        camera: such as ``image_2``.
        size: (height, width) of the images.
        advice: what to do where the file will not do.

    Raises:
        DatasetError: a row is missing or malformed.
    """
    rows = read_rows(path, advice)
    cam0_from_velo = _rigid(_row(rows, "Tr", 12, path, advice).reshape(3, 4), f"{path}, row Tr")
    return _rig(rows, f"P{camera[-1]}", cam0_from_velo, size, path)


def raw_rig(folder: Path, camera: str, size: tuple[int, int], advice: str) -> Rig:
    """Read ``calib_cam_to_cam.txt`` and ``calib_velo_to_cam.txt`` of KITTI's raw data.

    Args:
        folder: that holds both; or, where there is no such folder, one of KITTI's dates.
        camera: such as ``image_02``.
        size: (height, width) of the images.
        advice: what to do where the files will not do.

    Raises:
        DatasetError: a file or row is missing or malformed, or the images are of another size.
    """
    cameras, scanner = folder / "calib_cam_to_cam.txt", folder / "calib_velo_to_cam.txt"
    day = None if folder.is_dir() else DAYS.get(str(folder))
    if day is None:
        rows, velo = read_rows(cameras, advice), read_rows(scanner, advice)
    else:
        rows, velo = day.cameras(), day.scanner()
    turn = _row(velo, "R", 9, scanner, advice).reshape(3, 3)
    move = _row(velo, "T", 3, scanner, advice)
    unrectified_from_velo = _rigid(np.column_stack([turn, move]), f"{scanner}, rows R and T")
    rectify = _row(rows, "R_rect_00", 9, cameras, advice).reshape(3, 3)
    cam0_from_unrectified = _rigid(
        np.column_stack([rectify, np.zeros(3)]), f"{cameras}, row R_rect_00"
    )
    number = camera[-2:]
    rectified = rows.get(f"S_rect_{number}")
    if rectified is not None and tuple(rectified[::-1].astype(int)) != size:
        raise DatasetError(
            f"the images of {camera} are {size[1]}x{size[0]}, rectified ones of {cameras} are "
            f"{rectified[0]:g}x{rectified[1]:g}; use KITTI's 'synced+rectified' data of this date"
        )
    _row(rows, f"P_rect_{number}", 12, cameras, advice)
    cam0_from_velo = cam0_from_unrectified @ unrectified_from_velo
    return _rig(rows, f"P_rect_{number}", cam0_from_velo, size, cameras)


def _rig(
    rows: Mapping[str, Array], name: str, cam0_from_velo: Array, size: tuple[int, int], path: Path
) -> Rig:
    """Move from the first camera, which calibrations refer to, to one beside it."""
    P = _row(rows, name, 12, path, "use another camera").reshape(3, 4)
    intrinsics = check_intrinsics(P[:, :3], size, f"{path}, row {name}")
    cam_from_cam0 = np.eye(4)
    cam_from_cam0[:3, 3] = np.linalg.solve(intrinsics, P[:, 3])
    return Rig(cam_from_cam0 @ cam0_from_velo, intrinsics, size)


def _row(rows: Mapping[str, Array], name: str, num: int, path: Path, advice: str) -> Array:
    values = rows.get(name)
    if values is None:
        raise DatasetError(f"{path} has no row {name}; {advice}")
    if len(values) != num or not np.isfinite(values).all():
        raise DatasetError(f"row {name} of {path} must hold {num} numbers; {advice}")
    return values


def _rigid(motion: Array, source: str) -> Array:
    """Return a (3, 4) motion as (4, 4), its rotation mended where it was rounded."""
    out = np.eye(4)
    out[:3, :3] = orthonormal(motion[:, :3])
    out[:3, 3] = motion[:, 3]
    if np.abs(out[:3, :3] - motion[:, :3]).max() > MAX_SKEW:
        raise DatasetError(f"{source}: the 3x3 part is no rotation; download the file again")
    return out
