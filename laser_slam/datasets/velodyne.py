"""Scans of a Velodyne laser scanner beside a camera, as KITTI keeps them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.depth_registration import nearest_depth
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

BYTES_PER_POINT = 16  # float32 x, y, z, reflectance
MAX_RANGE_M = 500.0  # no scanner of KITTI's sees further: what lies beyond is a broken file
BEAM_OFFSET = np.radians(0.205)  # KITTI's scans lie this much too low, as KISS-ICP found
AGAIN = "download the scans again"
# A pixel is hidden where nearer points lie both above and below it: a nearer point on one side
# alone is the same road, ceiling or wall. The lines of the scanner lie 5 to 6 pixels apart.
HIDING_SIDE_PX = 4
HIDING_HEIGHT_PX = 7
HIDING_RATIO = 0.85
# The laser passes over near things at a distance from their outline that the places of scanner and
# camera give; as much again, for dark or shiny tops of cars send nothing back.
MUCH_NEARER = 0.6
OUTLINE_MARGIN = 1.0
LEAST_PARALLAX_PX = 1.5
BANDS_M = (0.0, 2.0, 3.0, 4.0, 5.5, 7.5, 10.0, 14.0, 20.0, 28.0, 40.0)


@dataclass(frozen=True)
class Rig:
    """How the scanner and a camera sit to each other.

    Attributes:
        cam_from_velo: (4, 4) rigid, metres; the scanner's axes are x forward, y left, z up.
        intrinsics: (3, 3) in pixels of the images.
        size: (height, width) of the images.
    """

    cam_from_velo: Array
    intrinsics: Array
    size: tuple[int, int]


@dataclass(frozen=True)
class Velodyne:
    """The scans of a sequence.

    Attributes:
        paths: file of each frame that has a scan; rising frames.
        times_s: (N,) seconds of all frames of the sequence.
        rig: the scanner and the camera.
        is_compensated: True where the motion of the car during a turn of the scanner is taken out.
    """

    paths: Mapping[int, Path]
    times_s: Array
    rig: Rig
    is_compensated: bool

    def check_files(self) -> None:
        """Look at the size of every file, so that a scan cut off is known before hours of work.

        Raises:
            DatasetError: one is missing, empty or cut off.
        """
        for path in self.paths.values():
            try:
                _check_size(path, path.stat().st_size)
            except OSError as error:
                raise DatasetError(f"cannot read {path} ({error.strerror}); {AGAIN}") from error

    def points(self, frame: int) -> Array:
        """Read a scan: (N, 3) points in metres, in the scanner's axes.

        Raises:
            DatasetError: the file is missing or broken.
        """
        return read_scan(self.paths[frame])

    def depth(self, frame: int) -> Depth | None:
        """Return what ``project_scan`` makes of a frame's scan; None: the frame has none.

        Raises:
            DatasetError: the file is missing or broken.
        """
        if frame not in self.paths:
            return None
        return project_scan(self.points(frame), self.rig)


def find_scans(folder: Path, num_frames: int) -> dict[int, Path]:
    """List the scans of a folder by the number in their name.

    Args:
        folder: with files such as ``000000.bin``.
        num_frames: of the sequence; scans beyond are left out.

    Raises:
        DatasetError: no such folder, or no scan of the sequence in it.
    """
    if not folder.is_dir():
        raise DatasetError(
            f"no folder {folder}; LiDAR needs the Velodyne scans of the sequence, which are a "
            "download of their own"
        )
    numbers = {int(path.stem): path for path in folder.glob("*.bin") if path.stem.isdecimal()}
    paths = {frame: numbers[frame] for frame in sorted(numbers) if frame < num_frames}
    if not paths:
        raise DatasetError(f"no scans such as 000000.bin of this sequence in {folder}; {AGAIN}")
    return paths


def read_scan(path: Path) -> Array:
    """Read (N, 3) points in metres, in the scanner's axes.

    Raises:
        DatasetError: the file is missing, cut off, or no scan.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"cannot read {path} ({error.strerror}); {AGAIN}") from error
    _check_size(path, len(data))
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    if not (np.abs(points) < MAX_RANGE_M).all():
        raise DatasetError(
            f"{path} is no scan: points that are not finite or beyond {MAX_RANGE_M:g} m; {AGAIN}"
        )
    return points


def _check_size(path: Path, num_bytes: int) -> None:
    if not num_bytes or num_bytes % BYTES_PER_POINT:
        raise DatasetError(
            f"{path} is no scan: {num_bytes} bytes, need {BYTES_PER_POINT} for each point; {AGAIN}"
        )


def raise_beams(points: Array) -> Array:
    """Turn (N, 3) points up by ``BEAM_OFFSET`` about the scanner, which is KITTI's to be mended."""
    out = points.copy()
    across = np.hypot(points[:, 0], points[:, 1])
    cos, sin = np.cos(BEAM_OFFSET), np.sin(BEAM_OFFSET)
    ratio = np.divide(
        across * cos - points[:, 2] * sin, across, out=np.ones_like(across), where=across > 0
    )
    out[:, :2] *= ratio[:, None]
    out[:, 2] = across * sin + points[:, 2] * cos
    return out


def turn_shares(points: Array) -> Array:
    """Return when in its turn the scanner saw each of (N, 3) points: from 0 (behind) to 1.

    It turns clockwise and begins behind the car.
    """
    return np.asarray(0.5 * (1 - np.arctan2(points[:, 1], points[:, 0]) / np.pi))


def project_scan(points: Array, rig: Rig) -> Depth:
    """Project a scan into the image; of several points in one pixel the nearest wins.

    The scanner looks over what hides things from the camera. So a pixel is left out where, within
    ``HIDING_SIDE_PX`` beside it, points less than ``HIDING_RATIO`` times as far lie both within
    ``HIDING_HEIGHT_PX`` above and as much below it; and where it lies just past the outline of
    something less than ``MUCH_NEARER`` times as far, which the scanner may see past, but not the
    camera.

    Args:
        points: (N, 3) in metres, in the scanner's axes.
        rig: the scanner and the camera.

    Returns:
        (H, W) depth z in metres, NaN: unknown, as it is in most pixels.
    """
    seen = points @ rig.cam_from_velo[:3, :3].T + rig.cam_from_velo[:3, 3]
    depth = nearest_depth(seen, rig.intrinsics, rig.size)
    is_hidden = _is_hidden(depth) | _is_behind_outline(depth, rig)
    depth[~np.isfinite(depth) | is_hidden] = np.nan
    return depth


def _is_hidden(depth: Depth) -> NDArray[np.bool_]:
    """Tell which pixels have nearer ones both above and below; infinite: nothing is known."""
    size = HIDING_HEIGHT_PX + 1, 2 * HIDING_SIDE_PX + 1
    limit = HIDING_RATIO * depth
    rows = (HIDING_HEIGHT_PX, 0)  # the kernel ends, or begins, in the pixel's own row
    above, below = (_least_around(depth, size, (HIDING_SIDE_PX, row)) for row in rows)
    return np.asarray((above < limit) & (below < limit))


def _is_behind_outline(depth: Depth, rig: Rig) -> NDArray[np.bool_]:
    """Tell which pixels the scanner alone may see, past the outlines of much nearer things.

    A road is safe: between points of which one is much nearer, it falls off by more than that.
    """
    out = np.zeros(depth.shape, np.bool_)
    for near_m, far_m in pairwise(BANDS_M):
        parallax_px = rig.intrinsics[[0, 1], [0, 1]] * rig.cam_from_velo[:2, 3] / far_m
        if np.abs(parallax_px).max() < LEAST_PARALLAX_PX:
            break
        band = np.where((depth >= near_m) & (depth < far_m), depth, np.float32(np.inf))
        ends = np.rint(np.outer([1.0, -OUTLINE_MARGIN], parallax_px)).astype(int)
        aside = np.array([HIDING_SIDE_PX, 0])
        low, high = ends.min(axis=0) - aside, ends.max(axis=0) + aside
        width, height = (high - low + 1).tolist()
        nearest = _least_around(band, (height, width), (int(-low[0]), int(-low[1])))
        out |= nearest < MUCH_NEARER * depth
    return out


def _least_around(depth: Depth, size: tuple[int, int], anchor: tuple[int, int]) -> Depth:
    """Return the least depth within (height, width) ``size``, in which (x, y) ``anchor`` lies."""
    nothing = float(np.finfo(np.float32).max)
    return np.asarray(
        cv2.erode(
            depth,
            np.ones(size, np.uint8),
            anchor=anchor,
            borderType=cv2.BORDER_CONSTANT,
            borderValue=nothing,
        )
    )
