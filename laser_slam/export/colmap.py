"""COLMAP's sparse model, which Gaussian splatting tools start from."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from laser_slam.export.base import Camera, Photo, Photos, Source, sample
from laser_slam.export.folders import atomic_folder
from laser_slam.types import Cloud

_MODEL_IDS = {"PINHOLE": 1, "OPENCV": 4}
_UNREADABLE = re.compile(r"[\s\ud800-\udfff]")  # its text ends a name there; or no UTF-8
_UNKNOWN = -1.0  # COLMAP's own mark for a reprojection error that nobody computed


def export_colmap(path: Path, source: Source) -> None:
    """Write ``images/`` and the binary model ``sparse/0``: cameras, images, points.

    Intrinsics are those of the photos, with the first pixel's centre at 0.5. Poses and points are
    in world units. Points are a part of the map and have no tracks. What COLMAP's text cannot say
    in a name of an image, such as a space, becomes ``_``, in the name of the file too.

    Raises:
        RunFolderError: a file cannot be written, or photos are missing.
    """
    with atomic_folder(path) as folder:
        photos, cloud, model = _prepare(folder, source)
        (model / "cameras.bin").write_bytes(_cameras_bin(photos))
        (model / "images.bin").write_bytes(_images_bin(photos))
        (model / "points3D.bin").write_bytes(_points_bin(cloud))


def export_colmap_text(path: Path, source: Source) -> None:
    """Write ``images/`` and the model as text in ``sparse/0``; see ``export_colmap``.

    Raises:
        RunFolderError: a file cannot be written, or photos are missing.
    """
    with atomic_folder(path) as folder:
        photos, cloud, model = _prepare(folder, source)
        _write_lines(model / "cameras.txt", _camera_lines(photos))
        _write_lines(model / "images.txt", _image_lines(photos))
        _write_lines(model / "points3D.txt", _point_lines(cloud))


def _prepare(folder: Path, source: Source) -> tuple[Photos, Cloud, Path]:
    """Save the photos; return them, the points and the folder of the model."""
    photos = source.photos()
    cloud = sample(source.points(), source.config.max_points)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    photos.save(folder / "images")
    return _rename(photos, folder / "images"), cloud, model


def _rename(photos: Photos, folder: Path) -> Photos:
    """Give the files names that both kinds of a model can hold."""
    names = _readable([photo.name for photo in photos.photos])
    for photo, name in zip(photos.photos, names, strict=True):
        if name != photo.name:
            (folder / photo.name).rename(folder / name)
    renamed = [replace(photo, name=name) for photo, name in zip(photos.photos, names, strict=True)]
    return replace(photos, photos=renamed)


def _readable(names: Sequence[str]) -> list[str]:
    """Replace what COLMAP cannot read, so that no two names become one.

    >>> _readable(["my drive 1.jpg", "my_drive_1.jpg", "2.jpg"])
    ['my_drive_1_.jpg', 'my_drive_1.jpg', '2.jpg']
    """
    taken, out = set(names), []
    for name in names:
        new = _UNREADABLE.sub("_", name)
        while new != name and new in taken:
            new = f"{Path(new).stem}_{Path(new).suffix}"
        taken.add(new)
        out.append(new)
    return out


def _model(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's name for the camera model, and its parameters."""
    if camera.is_pinhole:
        return "PINHOLE", camera.numbers
    return "OPENCV", [*camera.numbers, *(float(k) for k in camera.distortion)]


def _pose(photo: Photo) -> tuple[list[float], list[float]]:
    """Return ``cam_from_world`` as quaternion w x y z and translation."""
    cam_from_world = np.linalg.inv(photo.world_from_cam)
    quat_xyzw = Rotation.from_matrix(cam_from_world[:3, :3]).as_quat(canonical=True)
    return np.roll(quat_xyzw, 1).tolist(), cam_from_world[:3, 3].tolist()


def _cameras_bin(photos: Photos) -> bytes:
    parts = [struct.pack("<Q", len(photos.cameras))]
    for number, camera in enumerate(photos.cameras, start=1):
        name, params = _model(camera)
        height, width = camera.size
        parts.append(struct.pack("<iiQQ", number, _MODEL_IDS[name], width, height))
        parts.append(struct.pack(f"<{len(params)}d", *params))
    return b"".join(parts)


def _images_bin(photos: Photos) -> bytes:
    parts = [struct.pack("<Q", len(photos.photos))]
    for number, photo in enumerate(photos.photos, start=1):
        quat_wxyz, translation = _pose(photo)
        parts.append(struct.pack("<i7di", number, *quat_wxyz, *translation, photo.camera + 1))
        parts.append(photo.name.encode("utf-8") + b"\0" + struct.pack("<Q", 0))
    return b"".join(parts)


def _points_bin(cloud: Cloud) -> bytes:
    layout = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "|u1", 3), ("error", "<f8"), ("len", "<u8")]
    rows: NDArray[np.void] = np.zeros(len(cloud.points), np.dtype(layout))
    rows["id"] = np.arange(1, len(rows) + 1)
    rows["xyz"], rows["rgb"], rows["error"] = cloud.points, cloud.colors, _UNKNOWN
    return struct.pack("<Q", len(rows)) + rows.tobytes()


def _camera_lines(photos: Photos) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    for number, camera in enumerate(photos.cameras, start=1):
        name, params = _model(camera)
        height, width = camera.size
        yield " ".join([f"{number} {name} {width} {height}", *(repr(value) for value in params)])


def _image_lines(photos: Photos) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then the points, none here"
    for number, photo in enumerate(photos.photos, start=1):
        quat_wxyz, translation = _pose(photo)
        numbers = " ".join(repr(value) for value in [*quat_wxyz, *translation])
        yield f"{number} {numbers} {photo.camera + 1} {photo.name}"
        yield ""


def _point_lines(cloud: Cloud) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"
    for number, (point, color) in enumerate(zip(cloud.points, cloud.colors, strict=True), start=1):
        x, y, z = point.tolist()
        red, green, blue = color.tolist()
        yield f"{number} {x!r} {y!r} {z!r} {red} {green} {blue} {_UNKNOWN}"


def _write_lines(path: Path, lines: Iterator[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)
