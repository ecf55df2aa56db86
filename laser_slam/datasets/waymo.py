"""Waymo Open Dataset, converted to images, cameras and LiDAR depth as DUSt3R's script does it."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.exr import read_exr
from laser_slam.datasets.lens import Depth, Lens
from laser_slam.datasets.listed import ListedSequence, Shot, require
from laser_slam.datasets.poses import rigid_or_none
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

RATE_HZ = 10.0
CAMERAS = {1: "front", 2: "front left", 3: "front right", 4: "side left", 5: "side right"}
AGAIN = "convert the segment again"


@dataclass(frozen=True)
class _Camera:
    intrinsics: Array
    distortion: Array | None
    world_from_cam: Array | None  # None: no rigid motion


class Waymo(ListedSequence):
    """One segment: ``00000_1.jpg``, ``00000_1.exr`` and ``00000_1.npz`` for frame 0, camera 1.

    The ``.npz`` holds ``intrinsics`` (3, 3) and ``cam2world`` (4, 4, metres, our axes), the
    ``.exr`` LiDAR depth: z in metres at the pixels that were hit, 0 elsewhere. Intrinsics and lens
    distortion (``distortion``, 5 numbers) are the first frame's. 10 frames a second by the number.

    Args:
        folder: of one segment, ``segment-..._with_camera_labels.tfrecord``.
        camera: 1 to 5: front, front left, front right, side left, side right.
        rectify: take the lens distortion out, of images and depth.

    Raises:
        DatasetError: no such segment there, images of several sizes, or a broken camera file.
    """

    again = AGAIN

    def __init__(self, folder: Path, *, camera: int = 1, rectify: bool = False) -> None:
        if camera not in CAMERAS:
            listed = ", ".join(f"{number} {name}" for number, name in CAMERAS.items())
            raise DatasetError(f"Waymo has no camera {camera}; there is {listed}")
        images = _list_images(folder, camera)
        require(images, f"00000_{camera}.jpg", folder, "give the folder of one segment")
        cameras = {number: _read_camera(path) for number, path in images.items()}
        shots = [
            Shot(number / RATE_HZ, path, _depth_file(path), cameras[number].world_from_cam)
            for number, path in images.items()
        ]
        first = next(iter(cameras.values()))
        name = folder.resolve().name.removesuffix(".tfrecord").removesuffix("_with_camera_labels")
        super().__init__(
            f"waymo-{name.removeprefix('segment-')}-{CAMERAS[camera].replace(' ', '-')}",
            shots,
            Lens(
                first.intrinsics,
                "the .npz files, first frame",
                distortion=first.distortion,
            ),
            read_lidar_depth,
            rectify=rectify,
        )


def _list_images(folder: Path, camera: int) -> dict[int, Path]:
    ending = f"_{camera}"
    paths = folder.glob(f"*{ending}.jpg") if folder.is_dir() else iter(())
    found = {path.stem.removesuffix(ending): path for path in paths}
    numbers = {int(number): path for number, path in found.items() if number.isdecimal()}
    return {number: numbers[number] for number in sorted(numbers)}


def _depth_file(image: Path) -> Path | None:
    path = image.with_suffix(".exr")
    return path if path.is_file() else None


def _read_camera(image: Path) -> _Camera:
    path = image.with_suffix(".npz")
    try:
        with np.load(path, allow_pickle=False) as stored:
            intrinsics, world_from_cam = stored["intrinsics"], stored["cam2world"]
            distortion = np.ravel(stored["distortion"]) if "distortion" in stored else np.zeros(5)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        reason = getattr(error, "strerror", None) or error
        raise DatasetError(f"cannot read the camera {path} ({reason}); {AGAIN}") from error
    if intrinsics.shape != (3, 3) or world_from_cam.shape != (4, 4) or distortion.shape != (5,):
        raise DatasetError(
            f"{path} must hold intrinsics (3, 3), cam2world (4, 4) and, if at all, "
            f"distortion (5,); {AGAIN}"
        )
    return _Camera(
        intrinsics.astype(np.float64),
        distortion.astype(np.float64) if distortion.any() else None,
        rigid_or_none(world_from_cam.astype(np.float64)),
    )


def read_lidar_depth(path: Path, size: tuple[int, int]) -> Depth:
    """Read LiDAR depth: (H, W) z in metres, NaN: the LiDAR did not hit this pixel.

    Raises:
        DatasetError: the file is broken or of another size than (height, width) ``size``.
    """
    depth = read_exr(path, AGAIN)
    if depth.shape != size:
        raise DatasetError(
            f"{path} is {depth.shape[1]}x{depth.shape[0]}, the images are {size[1]}x{size[0]}; "
            f"{AGAIN}"
        )
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))
