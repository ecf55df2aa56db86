"""Depth, confidence, colour, intrinsics and pose of each keyframe."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.export.base import DepthView, Source
from laser_slam.export.folders import atomic_folder
from laser_slam.types import Image

_COUNTS = 65535
_FARTHEST = 0.999  # share of the known depths that 16 bits must hold
_MOST_PER_UNIT = 1000.0  # the millimetres of depth cameras, where the map is in metres
_EVERY = 4  # rows and columns that the range of depth is looked for in


def export_depth(path: Path, source: Source) -> None:
    """Write 16-bit depth PNGs, 8-bit confidence PNGs, colours, and ``frames.json``.

    Depth is z along the optical axis: ``counts_per_unit`` of ``frames.json`` counts are one world
    unit, the same for all frames; a power of ten, 1000 where the depths of the run fit. 0: unknown,
    or too far for 16 bits.

    Raises:
        RunFolderError: the run has no depth, or a file cannot be written.
    """
    per_unit = _counts_per_unit(source)
    frames = []
    with atomic_folder(path) as folder:
        for name in ("depth", "confidence", "images"):
            (folder / name).mkdir()
        for view in source.views(None):
            name = f"{view.frame:06d}.png"
            _save_png(folder / "depth" / name, _counts(view.depth, per_unit))
            confidence = np.rint(view.confidence * 255).astype(np.uint8)
            _save_png(folder / "confidence" / name, confidence)
            _save_png(folder / "images" / name, np.ascontiguousarray(view.color[..., ::-1]))
            frames.append(_describe(view, name))
        content = {"counts_per_unit": per_unit, "confidence_counts": 255, "frames": frames}
        (folder / "frames.json").write_text(json.dumps(content, indent=2), encoding="utf-8")


def export_depth_npz(path: Path, source: Source) -> None:
    """Write one ``.npz`` a keyframe, with what ``DepthView`` has by the same names.

    Raises:
        RunFolderError: the run has no depth, or a file cannot be written.
    """
    num = 0
    with atomic_folder(path) as folder:
        for view in source.views(None):
            with (folder / f"{view.frame:06d}.npz").open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **vars(view))
            num += 1
        if not num:
            raise _nothing(source)


def _describe(view: DepthView, name: str) -> dict[str, Any]:
    K = view.intrinsics
    return {
        "frame": view.frame,
        "time_s": view.time_s,
        "depth": f"depth/{name}",
        "confidence": f"confidence/{name}",
        "image": f"images/{name}",
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "world_from_cam": view.world_from_cam.tolist(),
    }


def _counts(depth: NDArray[np.float32], per_unit: float) -> NDArray[np.uint16]:
    counts = np.nan_to_num(np.rint(depth * per_unit), nan=0.0, posinf=np.inf)
    return np.where((counts > 0) & (counts <= _COUNTS), counts, 0).astype(np.uint16)


def _counts_per_unit(source: Source) -> float:
    """Find the power of ten at which nearly all depths fit into 16 bits."""
    reaches = []
    for view in source.views(None):
        depth = view.depth[::_EVERY, ::_EVERY]
        known = depth[np.isfinite(depth) & (depth > 0)]
        if known.size:
            reaches.append(float(np.quantile(known, _FARTHEST)))
    if not reaches:
        raise _nothing(source)
    return float(min(_MOST_PER_UNIT, 10 ** np.floor(np.log10(_COUNTS / max(reaches)))))


def _nothing(source: Source) -> RunFolderError:
    return RunFolderError(f"{source.name} has no depth: its backbone saw nothing")


def _save_png(path: Path, image: NDArray[np.uint16] | Image) -> None:
    """Write an image; OpenCV alone does not say why it could not."""
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
