"""MPI Sintel: a rendered film, with exact depth and cameras of its training part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.lens import Depth, Lens
from laser_slam.datasets.listed import ListedSequence, Shot, numbered_files, require
from laser_slam.datasets.poses import rigid_or_none
from laser_slam.errors import DatasetError
from laser_slam.sim3 import Sim3

Array = NDArray[np.float64]

FPS = 24.0
TAG = 202021.25  # begins every file of depth and of a camera
NO_DEPTH_M = 1e9  # what is beyond is the background, not a surface
AGAIN = "unpack the depth and camera archive of MPI Sintel again"


class Sintel(ListedSequence):
    """One sequence: ``training/PASS/SEQ/frame_0001.png``, PASS ``final`` or ``clean``.

    Depth is read from ``training/depth/SEQ/*.dpt`` (z in the film's unit, about a metre), cameras
    from ``training/camdata_left/SEQ/*.cam``. The film has 24 frames a second. Some of its cameras
    zoom: the intrinsics are the median over the sequence, and their source says how far they vary.

    Args:
        folder: of one sequence, such as ``training/final/alley_2``.

    Raises:
        DatasetError: no such sequence there, images of several sizes, or a broken camera file.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        folder = folder.resolve()
        images = numbered_files(folder, "frame_", (".png",))
        require(images, "frame_0001.png", folder, "give a sequence such as training/final/alley_2")
        training, name = folder.parent.parent, folder.name
        depth = numbered_files(training / "depth" / name, "frame_", (".dpt",))
        camera_files = numbered_files(training / "camdata_left" / name, "frame_", (".cam",))
        cameras = {number: _read_camera(path) for number, path in camera_files.items()}
        shots = [
            Shot(number / FPS, path, depth.get(number), cameras.get(number, (None, None))[1])
            for number, path in images.items()
        ]
        super().__init__(
            f"sintel-{folder.parent.name}-{name}",
            shots,
            _lens([intrinsics for intrinsics, _ in cameras.values()]),
            read_dpt,
        )


def _lens(all_intrinsics: list[Array]) -> Lens:
    if not all_intrinsics:
        return Lens(None, "unknown: no files in training/camdata_left")
    focal = np.array([intrinsics[0, 0] for intrinsics in all_intrinsics])
    source = "training/camdata_left"
    spread = float(focal.max() / focal.min() - 1)
    if spread > 1e-3:
        source += f", median; the camera zooms by {100 * spread:.1f} %"
    return Lens(np.median(np.stack(all_intrinsics), axis=0), source)


def read_dpt(path: Path, size: tuple[int, int]) -> Depth:
    """Read a ``.dpt`` file: tag, width, height, then float32 row by row, little endian.

    Args:
        path: of the file.
        size: (height, width) that it must have.

    Returns:
        (H, W) z in the film's unit, NaN: background.

    Raises:
        DatasetError: the file is no such file, cut, or of another size.
    """
    data = path.read_bytes()
    height, width = size
    head = np.frombuffer(data[4:12].ljust(8, b"\0"), "<i4")
    if not _is_tagged(data) or tuple(head) != (width, height):
        raise DatasetError(f"{path} is no .dpt file of {width}x{height} pixels; {AGAIN}")
    if len(data) != 12 + 4 * width * height:
        raise DatasetError(f"{path} is cut: {len(data)} bytes; {AGAIN}")
    depth = np.frombuffer(data, "<f4", offset=12).reshape(size)
    known = np.isfinite(depth) & (depth > 0) & (depth < NO_DEPTH_M)
    return np.where(known, depth, np.nan).astype(np.float32)


def _read_camera(path: Path) -> tuple[Array, Array | None]:
    """Read a ``.cam`` file: tag, float64 intrinsics (3, 3), float64 cam_from_world (3, 4).

    Returns:
        The intrinsics, and ``world_from_cam``, None: no rigid motion.
    """
    data = path.read_bytes()
    if not _is_tagged(data) or len(data) != 4 + 8 * (9 + 12):
        raise DatasetError(f"{path} is no .cam file of MPI Sintel; {AGAIN}")
    numbers = np.frombuffer(data, "<f8", offset=4)
    cam_from_world = rigid_or_none(np.vstack([numbers[9:].reshape(3, 4), [0, 0, 0, 1]]))
    intrinsics = np.array(numbers[:9], np.float64).reshape(3, 3)
    if cam_from_world is None:
        return intrinsics, None
    return intrinsics, Sim3.from_matrix(cam_from_world).inverse().matrix()


def _is_tagged(data: bytes) -> bool:
    return len(data) >= 4 and float(np.frombuffer(data, "<f4", 1)[0]) == TAG
