"""nerfstudio's transforms.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from laser_slam.export.base import Camera, Photo, Source, sample
from laser_slam.export.clouds import write_ply
from laser_slam.export.folders import atomic_folder

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backward


def export_nerfstudio(path: Path, source: Source) -> None:
    """Write ``transforms.json``, ``images/`` and ``points.ply``, as ``ns-train --data`` takes them.

    Camera axes are OpenGL's; the world is the run's, in its units. Intrinsics are those of the
    photos, with the first pixel's centre at 0.5.

    Raises:
        RunFolderError: a file cannot be written, or photos are missing.
    """
    with atomic_folder(path) as folder:
        photos = source.photos()
        (folder / "images").mkdir()
        photos.save(folder / "images")
        write_ply(folder / "points.ply", sample(source.points(), source.config.max_points))
        content: dict[str, Any] = {"camera_model": "OPENCV", "ply_file_path": "points.ply"}
        shared = len(photos.cameras) == 1
        if shared:
            content |= _describe(photos.cameras[0])
        content["frames"] = [
            _frame(photo, None if shared else photos.cameras[photo.camera])
            for photo in photos.photos
        ]
        (folder / "transforms.json").write_text(json.dumps(content, indent=2), encoding="utf-8")


def _frame(photo: Photo, camera: Camera | None) -> dict[str, Any]:
    """Describe a photo; with its camera where the photos have several."""
    world_from_cam = photo.world_from_cam @ _OPENCV_FROM_OPENGL
    return {
        "file_path": f"images/{photo.name}",
        **({} if camera is None else _describe(camera)),
        "transform_matrix": world_from_cam.tolist(),
    }


def _describe(camera: Camera) -> dict[str, Any]:
    height, width = camera.size
    names = ["fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"]
    numbers = [*camera.numbers, *(float(k) for k in camera.distortion)]
    return {"w": width, "h": height, **dict(zip(names, numbers, strict=True))}
