"""One drive of KITTI's raw data, synchronised and rectified, with its LiDAR scans."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.decoding import SUFFIXES, check_same_kind
from laser_slam.datasets.kitti_calibration import raw_rig
from laser_slam.datasets.kitti_dates import DAYS
from laser_slam.datasets.lens import Lens
from laser_slam.datasets.listed import ListedSequence, Shot
from laser_slam.datasets.velodyne import Velodyne, find_scans, project_scan, read_scan
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

CAMERAS = ("image_02", "image_00")  # left colour, then left grey
FPS = 10.0
AGAIN = "unpack the drive again"
CALIBRATION_ADVICE = (
    "pass --calibration, the folder of the date's calib_cam_to_cam.txt and calib_velo_to_cam.txt, "
    f"or, for KITTI's own drives, the date: {', '.join(DAYS)}"
)
logger = logging.getLogger(__name__)


class KittiRaw(ListedSequence):
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

    again = AGAIN

    def __init__(
        self, folder: Path, calibration: Path | str | None = None, camera: str | None = None
    ) -> None:
        images, paths = _find_images(folder, camera)
        camera = images.relative_to(folder).parts[0]
        where = Path(calibration) if calibration else _find_calibration(folder)
        size = check_same_kind(paths[:1], AGAIN).size
        self._rig = rig = raw_rig(where, camera, size, CALIBRATION_ADVICE)
        self._scans_folder = folder / "velodyne_points"
        self._times_s = _read_times(folder / camera / "timestamps.txt", len(paths))
        scans = self._scans_if_any()
        super().__init__(
            f"kitti-raw-{folder.resolve().name}",
            [
                Shot(float(time_s), path, scans.get(frame))
                for frame, (time_s, path) in enumerate(zip(self._times_s, paths, strict=True))
            ],
            Lens(rig.intrinsics, f"{_calibration_name(where)}, row P_rect_{camera[-2:]}"),
            lambda scan, _size: project_scan(read_scan(scan), rig),
        )

    def velodyne(self) -> Velodyne:
        """Return the LiDAR scans of the drive, as the scanner turned: not compensated.

        Raises:
            DatasetError: there are none.
        """
        paths = find_scans(_inner(self._scans_folder), len(self._times_s))
        return Velodyne(paths, self._times_s, self._rig, is_compensated=False)

    def _scans_if_any(self) -> Mapping[int, Path]:
        """Look for scans, without which a drive can be mapped as well."""
        if not self._scans_folder.is_dir():
            return {}
        try:
            return self.velodyne().paths
        except DatasetError as error:
            logger.warning("no depth from LiDAR: %s", error)
            return {}


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
