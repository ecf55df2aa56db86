"""Binary glTF 2.0: one file that every 3D viewer opens."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.store import atomic_write

_FLOAT, _UNSIGNED_SHORT, _UNSIGNED_INT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963
_LIMIT = 2**32 - 2**20  # bytes: the format counts them in 32 bits
_Block = tuple[NDArray[Any], int, str, int]  # numbers, their type, what they form, and for what
_GLTF_FROM_WORLD = np.array([1, -1, -1], np.float32)  # y up, z towards the viewer


def write_glb(
    path: Path,
    vertices: NDArray[np.float32],
    normals: NDArray[np.float32],
    colors: NDArray[np.uint8],
    triangles: NDArray[np.int32],
) -> None:
    """Write a coloured mesh, turned to glTF's axes; its colours are shown as they are, unlit.

    Args:
        path: of the file.
        vertices: (N, 3) x right, y down, z forward.
        normals: (N, 3) unit.
        colors: (N, 3) RGB as images have it; glTF wants it linear, and gets it so.
        triangles: (M, 3) rows of ``vertices``.

    Raises:
        RunFolderError: the mesh is too large for the format, or the file cannot be written.
    """
    arrays: list[_Block] = [
        (np.ascontiguousarray(vertices * _GLTF_FROM_WORLD), _FLOAT, "VEC3", _VERTICES),
        (np.ascontiguousarray(normals * _GLTF_FROM_WORLD), _FLOAT, "VEC3", _VERTICES),
        (_linear(colors), _UNSIGNED_SHORT, "VEC4", _VERTICES),
        (triangles.astype(np.uint32).ravel(), _UNSIGNED_INT, "SCALAR", _INDICES),
    ]
    num_bytes = sum(array.nbytes for array, *_ in arrays)
    if num_bytes > _LIMIT:
        raise RunFolderError(
            f"the mesh has {num_bytes:,} bytes, more than a GLB file can hold; "
            "raise export.mesh_voxel, or export mesh-ply"
        )
    text = json.dumps(_describe(arrays, num_bytes)).encode("ascii")
    text += b" " * (-len(text) % 4)
    with atomic_write(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + num_bytes))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", num_bytes, b"BIN\0"))
        for array, *_ in arrays:
            array.tofile(file)


def _describe(arrays: list[_Block], num_bytes: int) -> dict[str, Any]:
    views, accessors, start = [], [], 0
    for number, (array, component, kind, target) in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes})
        views[-1]["target"] = target
        accessors.append(
            {"bufferView": number, "componentType": component, "count": len(array), "type": kind}
        )
        start += array.nbytes
    accessors[0] |= {"min": _corner(arrays[0][0], np.min), "max": _corner(arrays[0][0], np.max)}
    accessors[2]["normalized"] = True
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    primitive = {"attributes": attributes, "indices": 3, "material": 0, "mode": 4}
    material = {"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
    return {
        "asset": {"version": "2.0", "generator": "laser-slam"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": num_bytes}],
    }


def _corner(positions: NDArray[Any], extreme: Any) -> list[float]:
    return [float(value) for value in extreme(positions, axis=0)]


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Undo sRGB's gamma: (N, 3) bytes to (N, 4) of 16 bits of light, opaque."""
    level = np.arange(256) / 255
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    table = np.rint(65535 * light).astype(np.uint16)
    rgba = np.full((len(colors), 4), 65535, np.uint16)
    rgba[:, :3] = table[colors]
    return rgba
