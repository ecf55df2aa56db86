"""One drive of KITTI's raw data, synchronised and rectified, with its LiDAR scans."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.decoding import (
    SUFFIXES,
    Stream,
    check_same_kind,
    give_up_if_unreadable,
    read_ahead,
    read_image,
)
from laser_slam.datasets.kitti_calibration import raw_rig
from laser_slam.datasets.kitti_dates import DAYS
from laser_slam.datasets.velodyne import Depth, Velodyne, find_scans
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo

Array = NDArray[np.float64]

CAMERAS = ("image_02", "image_00")  # left colour, then left grey
FPS = 10.0
AGAIN = "unpack the drive again"
CALIBRATION_ADVICE = (
    "pass --calibration, the folder of the date's calib_cam_to_cam.txt and calib_velo_to_cam.txt, "
    f"or, for KITTI's own drives, the date: {', '.join(DAYS)}"
)
logger = logging.getLogger(__name__)


class KittiRaw:
    """A drive: ``image_02/data``, ``image_02/timestamps.txt`` and ``velodyne_points/data``.

    The files may also lie in ``image_02`` and ``velodyne_points`` themselves. Without timestamps
    frames are 10 a second. The calibration of the date lies in the drive's folder or the one
    above. Scans are optional, and so is a scan for each frame; they give true depth. Poses there
    are none: those of the GPS are no match for KITTI odometry's.

    Args:
        folder: of the drive, such as ``2011_09_26/2011_09_26_drive_0001_sync``.
        calibration: folder that holds the calibration files, or a date of KITTI's, such as
            ``2011_09_26``; None: the files are where KITTI puts them.
        camera: such as ``image_03``; None: left colour if it is there, else left grey.

    Raises:
        DatasetError: images or calibration are missing or malformed.
    """

    def __init__(
        self, folder: Path, calibration: Path | None = None, camera: str | None = None
    ) -> None:
        self._folder = folder
        self._images_folder, self._paths = _find_images(folder, camera)
        size = check_same_kind(self._paths, AGAIN).size
        name = folder.resolve().name
        where = calibration or _find_calibration(folder)
        camera = self._images_folder.relative_to(folder).parts[0]
        self._rig = raw_rig(where, camera, size, CALIBRATION_ADVICE)
        self._times_s = _read_times(folder / camera / "timestamps.txt", len(self._paths))
        self._info = SequenceInfo(
            f"kitti-raw-{name}",
            size,
            len(self._paths),
            self._rig.intrinsics,
            f"{_calibration_name(where)}, row P_rect_{camera[-2:]}",
            files=tuple(self._paths),
        )
        self._velodyne = self._find_velodyne()

    @property
    def info(self) -> SequenceInfo:
        """Say what is known before the images are read."""
        return self._info

    def frames(self) -> Stream[Frame]:
        """Read the images in order, a few ahead; an unreadable one comes as None.

        Raises:
            DatasetError: the first image or more than half of all are unreadable.
        """
        jobs = (partial(self._read, index) for index in range(len(self._paths)))
        return give_up_if_unreadable(read_ahead(jobs), self._images_folder, len(self._paths))

    def true_depth(self, frame: int) -> Depth | None:
        """Return the (H, W) depth z in metres that LiDAR saw, NaN: unknown; None: no scan.

        Raises:
            DatasetError: the scan is broken.
        """
        return None if self._velodyne is None else self._velodyne.depth(frame)

    def velodyne(self) -> Velodyne:
        """Return the LiDAR scans of the drive, as the scanner turned: not compensated.

        Raises:
            DatasetError: there are none.
        """
        paths = find_scans(_inner(self._folder / "velodyne_points"), len(self._paths))
        return Velodyne(paths, self._times_s, self._rig, is_compensated=False)

    def _find_velodyne(self) -> Velodyne | None:
        """Look for scans, without which a drive can be mapped as well."""
        if not (self._folder / "velodyne_points").is_dir():
            return None
        try:
            return self.velodyne()
        except DatasetError as error:
            logger.warning("no depth from LiDAR: %s", error)
            return None

    def _read(self, index: int) -> Frame:
        return Frame(index, float(self._times_s[index]), read_image(self._paths[index]))


def _inner(folder: Path) -> Path:
    return folder / "data" if (folder / "data").is_dir() else folder


def _find_images(folder: Path, camera: str | None) -> tuple[Path, list[Path]]:
    """Find the images; their names must count from 0, for scans and times go by number."""
    wanted = CAMERAS if camera is None else (camera,)
    images = next((_inner(folder / one) for one in wanted if (folder / one).is_dir()), None)
    if images is None:
        raise DatasetError(
            f"no images in {folder / ' or '.join(wanted)}; give the folder of a drive, such as "
            "2011_09_26/2011_09_26_drive_0001_sync"
        )
    numbers = {
        int(path.stem): path
        for path in images.iterdir()
        if path.suffix.lower() in SUFFIXES and path.stem.isdecimal()
    }
    missing = sorted(set(range(max(numbers, default=0) + 1)) - set(numbers))
    if missing:
        raise DatasetError(f"image {missing[0]:010d} is missing in {images}; {AGAIN}")
    return images, [numbers[number] for number in sorted(numbers)]


def _calibration_name(where: Path) -> str:
    is_date = not where.is_dir() and str(where) in DAYS
    return f"KITTI's calibration of {where}" if is_date else "calib_cam_to_cam.txt"


def _find_calibration(folder: Path) -> Path:
    for candidate in (folder, folder.resolve().parent):
        if (candidate / "calib_cam_to_cam.txt").is_file():
            return candidate
    raise DatasetError(
        f"no calib_cam_to_cam.txt in {folder} or the folder above; {CALIBRATION_ADVICE}"
    )


def _read_times(path: Path, num_images: int) -> Array:
    """Read lines such as ``2011-09-26 13:02:25.594360375``; seconds since the first."""
    if not path.is_file():
        logger.info("no %s: frames are taken as %g a second", path, FPS)
        return np.arange(num_images) / FPS
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
        stamps = np.array([line.strip() for line in lines if line.strip()], "datetime64[ns]")
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read times from {path} ({error}); {AGAIN}") from error
    times_s = (stamps - stamps[:1]).astype(np.float64) / 1e9
    if len(times_s) != num_images or not (np.diff(times_s) > 0).all():
        raise DatasetError(
            f"{path} must hold {num_images} rising times, one for each image; {AGAIN}"
        )
    return np.asarray(times_s, np.float64)
