"""ScanNet: rooms scanned with a depth camera, as its ``.sens`` files are exported."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.decoding import read_depth, read_header
from laser_slam.datasets.depth_registration import look_up_depth
from laser_slam.datasets.lens import Depth, Lens
from laser_slam.datasets.listed import ListedSequence, Shot, numbered_files, require
from laser_slam.datasets.poses import (
    matrix_of_words,
    read_matrix,
    read_pose,
    read_rows,
    rigid_or_none,
)
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

FPS = 30.0
PREPARED_STEP = 3  # of the frames that published evaluations copy
UNITS_PER_M = 1000.0
IMAGES = (".jpg", ".jpeg", ".png")
PREPARED = "color_"  # begins the folder of those frames
INFO_ROW = "m_calibration{}Intrinsic"
AGAIN = "export the scene's .sens file again"
EXPORT = (
    "export it with ScanNet's SensReader/python/reader.py: --export_color_images "
    "--export_depth_images --export_poses --export_intrinsics"
)


class ScanNet(ListedSequence):
    """One scene: ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt``, ``intrinsic/*.txt``.

    That is what ScanNet's Python reader exports. What its C++ reader does is read as well
    (``frame-000000.color.jpg``, ``.depth.pgm``, ``.pose.txt`` and ``_info.txt``), and the folder
    of chosen frames that published evaluations copy: ``color_90/frame_0000.jpg`` with ``depth_90``
    and ``pose_90.txt`` beside it, every third frame of the scene.

    Depth is 16 bits, in millimetres, 0: unknown, of a camera of its own (640x480 for 1296x968) at
    the same place: each pixel of the colour image gets the nearest depth in its direction, by the
    intrinsics of both. Without those of depth it is taken as registered with the images. A frame
    whose pose is missing or not finite has no true pose. There are no times: 30 frames a second by
    the number in the name.

    Args:
        folder: of one scene, such as ``scene0707_00``; or its ``color_90``.

    Raises:
        DatasetError: no such scene there, images of several sizes, or a broken pose file.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        named = folder.resolve()
        scene = named
        if named.name.startswith(PREPARED) and not (named / "color").is_dir():
            scene, shots = named.parent, _prepared(named)
        elif _cpp_files(folder, "color", IMAGES):
            shots = _exported_by_cpp(folder)
        else:
            shots = _exported(folder)
        lens = _lens(scene)
        read = partial(_read_scaled_depth, depth_K=_read_intrinsics(scene, "depth"), color=lens)
        super().__init__(f"scannet-{scene.name}", shots, lens, read)


def _exported(folder: Path) -> list[Shot]:
    color = numbered_files(folder / "color", "", IMAGES)
    require(color, "0.jpg", folder / "color", _advice(folder))
    depth = numbered_files(folder / "depth", "", (".png",))
    return [
        Shot(
            number / FPS,
            path,
            depth.get(number),
            read_pose(folder / "pose" / f"{path.stem}.txt", AGAIN),
        )
        for number, path in color.items()
    ]


def _advice(folder: Path) -> str:
    """Say what to give instead of a folder without ``color``."""
    prepared = sorted(path for path in folder.glob(f"{PREPARED}*") if path.is_dir())
    if prepared:
        return f"give {prepared[0]} for the frames that were chosen"
    for sens in sorted(folder.glob("*.sens")):
        return f"there is {sens.name}: {EXPORT}"
    return "give the folder of one exported scene"


def _exported_by_cpp(folder: Path) -> list[Shot]:
    depth = _cpp_files(folder, "depth", (".pgm", ".png"))
    return [
        Shot(
            number / FPS,
            path,
            depth.get(number),
            read_pose(path.with_name(f"{path.name.split('.')[0]}.pose.txt"), AGAIN),
        )
        for number, path in _cpp_files(folder, "color", IMAGES).items()
    ]


def _cpp_files(folder: Path, kind: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """List files such as ``frame-000000.color.jpg`` by their numbers."""
    found = {
        int(path.name.split(".")[0].removeprefix("frame-")): path
        for path in folder.glob(f"frame-*.{kind}.*")
        if path.suffix in suffixes and path.name.split(".")[0].removeprefix("frame-").isdecimal()
    }
    return {number: found[number] for number in sorted(found)}


def _prepared(folder: Path) -> list[Shot]:
    color = numbered_files(folder, "frame_", IMAGES)
    require(color, "frame_0000.jpg", folder, "give the folder of one exported scene")
    which = folder.name.removeprefix(PREPARED)
    depth = numbered_files(folder.with_name(f"depth_{which}"), "frame_", (".png",))
    poses = folder.with_name(f"pose_{which}.txt")
    rows = read_rows(poses, AGAIN) if poses.is_file() else []
    if rows and len(rows) <= max(color):
        raise DatasetError(f"{poses} has {len(rows)} lines for {len(color)} images; {AGAIN}")
    return [
        Shot(
            PREPARED_STEP * number / FPS,
            path,
            depth.get(number),
            rigid_or_none(matrix_of_words(poses, *rows[number], AGAIN)) if rows else None,
        )
        for number, path in color.items()
    ]


def _lens(folder: Path) -> Lens:
    intrinsics = _read_intrinsics(folder, "color")
    if intrinsics is None:
        return Lens(None, "unknown: no intrinsic/intrinsic_color.txt")
    is_by_cpp = (folder / "_info.txt").is_file()
    return Lens(intrinsics, "_info.txt" if is_by_cpp else "intrinsic/intrinsic_color.txt")


def _read_intrinsics(folder: Path, camera: str) -> Array | None:
    """Read those of ``color`` or ``depth``; None: neither reader has left them."""
    path, info = folder / "intrinsic" / f"intrinsic_{camera}.txt", folder / "_info.txt"
    if path.is_file():
        return read_matrix(path, 4, AGAIN)[:3, :3]
    if not info.is_file():
        return None
    row = INFO_ROW.format(camera.capitalize())
    for number, words in read_rows(info, AGAIN):
        if words[0] == row:
            return matrix_of_words(info, number, words[2:], AGAIN)[:3, :3]
    raise DatasetError(f"{info} has no row {row}; {AGAIN}")


def _read_scaled_depth(
    path: Path, size: tuple[int, int], depth_K: Array | None, color: Lens
) -> Depth:
    header = read_header(path)
    if header is None:
        raise DatasetError(f"{path} is no image; {AGAIN}")
    depth, color_K = read_depth(path, header.size, UNITS_PER_M, AGAIN), color.at(size)
    if depth_K is not None and color_K is not None:
        return look_up_depth(depth, depth_K, color_K, size)
    if header.size == size:
        return depth
    # INTER_NEAREST would take each block's corner, half a block off
    return np.asarray(cv2.resize(depth, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT))
