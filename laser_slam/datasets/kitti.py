"""KITTI odometry in its official layout, and what is written in the same layout."""

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
    read_depth,
    read_image,
)
from laser_slam.datasets.intrinsics import check_intrinsics
from laser_slam.datasets.kitti_calibration import odometry_rig
from laser_slam.datasets.velodyne import Velodyne, find_scans
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo, Trajectory

Array = NDArray[np.float64]

CAMERAS = ("image_2", "image_0")  # left colour, then left grey
DEPTH_UNITS_PER_M = 256.0
ROOT_ADVICE = "pass --root, or set LASER_SLAM_KITTI, to the folder that holds 'sequences'"
AGAIN = "download the sequence again"
CALIBRATION = "unpack KITTI's data_odometry_calib.zip, which holds it"
TR_ADVICE = "take calib.txt of KITTI's calibration download, which has it"
logger = logging.getLogger(__name__)


class KittiOdometry:
    """One sequence: ``sequences/<seq>/{image_*,calib.txt,times.txt}`` and ``poses/<seq>.txt``.

    The poses are optional. They are the official ones, of the left grey camera (cam0 to world,
    metres), whichever camera is used: the left colour camera sits 6 cm beside it, with parallel
    axes. ``depth/%06d.png`` (16 bits, metres times 256, 0: unknown) is read where it is there, else
    the true depth comes from the scans in ``velodyne`` where these are.

    Args:
        root: the folder that holds ``sequences``, or the one above it that holds ``dataset``.
        sequence: such as ``03``; ``3`` means the same.
        camera: ``image_0`` to ``image_3``; None: left colour if it is there, else left grey.

    Raises:
        DatasetError: something is missing, malformed or of another length than the images.
    """

    def __init__(self, root: Path, sequence: str, camera: str | None = None) -> None:
        root = _find_root(root)
        name = f"{int(sequence):02d}" if sequence.isdecimal() else sequence
        self._folder = _find_sequence(root, name)
        images = _find_images(self._folder, name, camera)
        self._images_folder = images
        self._paths = _list_frames(images)
        num = len(self._paths)
        self._times_s = _read_times(self._folder / "times.txt", num)
        header = check_same_kind(self._paths, AGAIN)
        intrinsics, source = _read_calibration(self._folder / "calib.txt", images, header.size)
        truth = _read_truth(root / "poses" / f"{name}.txt", self._times_s)
        self._info = SequenceInfo(
            f"kitti-{name}", header.size, num, intrinsics, source, truth, tuple(self._paths)
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

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        """Return the (H, W) true depth z in metres, NaN: unknown; None: there is none.

        Raises:
            DatasetError: the depth map is broken, not 16-bit grey, or of another size; the scan
                is broken.
        """
        path = self._folder / "depth" / f"{frame:06d}.png"
        if not path.is_file():
            return None if self._velodyne is None else self._velodyne.depth(frame)
        advice = "write it again, or remove the folder 'depth'"
        return read_depth(path, self._info.size, DEPTH_UNITS_PER_M, advice)

    def velodyne(self) -> Velodyne:
        """Return the LiDAR scans of the sequence, whose motion is compensated.

        Raises:
            DatasetError: there are none, or ``calib.txt`` does not say where the scanner is.
        """
        paths = find_scans(self._folder / "velodyne", len(self._paths))
        calibration = self._folder / "calib.txt"
        rig = odometry_rig(calibration, self._images_folder.name, self._info.size, TR_ADVICE)
        return Velodyne(paths, self._times_s, rig, is_compensated=True)

    def _find_velodyne(self) -> Velodyne | None:
        """Look for scans, which most copies of KITTI lack."""
        if not (self._folder / "velodyne").is_dir():
            return None
        try:
            return self.velodyne()
        except DatasetError as error:
            logger.warning("no depth from LiDAR: %s", error)
            return None

    def _read(self, index: int) -> Frame:
        return Frame(index, float(self._times_s[index]), read_image(self._paths[index]))


def _find_root(root: Path) -> Path:
    above = [root.parent] if root.name == "sequences" else []
    for candidate in [root, root / "dataset", *above]:
        if (candidate / "sequences").is_dir():
            return candidate
    raise DatasetError(f"no folder 'sequences' in {root}; {ROOT_ADVICE}")


def _find_sequence(root: Path, name: str) -> Path:
    folder = root / "sequences" / name
    if folder.is_dir():
        return folder
    there = sorted(path.name for path in (root / "sequences").iterdir() if path.is_dir())
    listed = f" (there: {', '.join(there[:25])})" if there else " (it is empty)"
    raise DatasetError(f"no KITTI sequence {name} in {root / 'sequences'}{listed}; {ROOT_ADVICE}")


def _find_images(folder: Path, name: str, camera: str | None) -> Path:
    wanted = CAMERAS if camera is None else (camera,)
    for one in wanted:
        if (folder / one).is_dir():
            return folder / one
    raise DatasetError(
        f"no images of KITTI sequence {name} in {folder / ' or '.join(wanted)}; {ROOT_ADVICE}"
    )


def _list_frames(folder: Path) -> list[Path]:
    """List the images; their names must count from 0, for times and poses go by line."""
    numbers = {
        int(path.stem): path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and path.stem.isdecimal()
    }
    if not numbers:
        raise DatasetError(f"no images such as 000000.png in {folder}; {ROOT_ADVICE}")
    for expected, number in enumerate(sorted(numbers)):
        if expected != number:
            raise DatasetError(
                f"image {expected:06d} is missing in {folder}, which goes on to "
                f"{max(numbers):06d}; {AGAIN}"
            )
    return [numbers[number] for number in sorted(numbers)]


def _read_times(path: Path, num_images: int) -> Array:
    """Read the seconds of the frames; the file says how long the sequence is."""
    times = _read_table(path, 1)[:, 0]
    if len(times) != num_images:
        cut = f"or cut {path.name} to {num_images} lines to use these images only"
        advice = f"{AGAIN}, {cut}" if len(times) > num_images else AGAIN
        raise DatasetError(f"{path} has {len(times)} times for {num_images} images; {advice}")
    falls = np.flatnonzero(np.diff(times) <= 0)
    if len(falls):
        line = int(falls[0]) + 2
        raise DatasetError(
            f"the times in {path} do not rise at line {line}: {times[line - 2]:g} s, then "
            f"{times[line - 1]:g} s; {AGAIN}"
        )
    return times


def _read_calibration(path: Path, images: Path, size: tuple[int, int]) -> tuple[Array, str]:
    row = f"P{images.name[-1]}"
    for line in _read_lines(path):
        label, _, values = line.partition(":")
        if label.strip() == row:
            break
    else:
        raise DatasetError(
            f"{path} has no row {row}, which belongs to {images.name}; {AGAIN}, "
            "or use another camera"
        )
    numbers = _parse(values)
    if numbers is None or len(numbers) != 12:
        raise DatasetError(f"row {row} of {path} must hold 12 numbers, got '{values.strip():.60}'")
    source = f"calib.txt, row {row}"
    return check_intrinsics(numbers.reshape(3, 4)[:, :3], size, f"{path}, row {row}"), source


def _read_truth(path: Path, times_s: Array) -> Trajectory | None:
    """Read cam0-to-world poses; None: there are none.

    More poses than frames are fine here: the sequence is as long as times.txt says, and who cut
    that and the images left the rest out on purpose.
    """
    if not path.is_file():
        return None
    rows, num = _read_table(path, 12), len(times_s)
    if len(rows) < num:
        raise DatasetError(
            f"{path} has {len(rows)} poses for {num} images; download the poses again, or remove "
            "the file to run without ground truth"
        )
    world_from_cam = np.tile(np.eye(4), (num, 1, 1))
    world_from_cam[:, :3] = rows[:num].reshape(-1, 3, 4)
    rotation = world_from_cam[:, :3, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    if off.max() > 1e-3:
        raise DatasetError(
            f"line {int(off.argmax()) + 1} of {path} is no pose (its 3x3 part is no rotation); "
            "download the poses again"
        )
    return Trajectory(np.arange(num), times_s, world_from_cam)


def _read_table(path: Path, columns: int) -> Array:
    """Read lines of ``columns`` finite numbers each."""
    rows = [_parse(line) for line in _read_lines(path)]
    for number, row in enumerate(rows, start=1):
        if row is None or len(row) != columns or not np.isfinite(row).all():
            raise DatasetError(
                f"line {number} of {path} must hold {columns} "
                f"number{'s' if columns > 1 else ''}; {AGAIN}"
            )
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").rstrip().splitlines()
    except OSError as error:
        advice = CALIBRATION if isinstance(error, FileNotFoundError) else AGAIN
        raise DatasetError(f"cannot read {path} ({error.strerror}); {advice}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is not a text file; {AGAIN}") from error


def _parse(text: str) -> Array | None:
    try:
        return np.array([float(part) for part in text.split()])
    except ValueError:
        return None
