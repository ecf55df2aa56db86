"""The world's triangles, and the faces that say what each of them looks like."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Color = tuple[float, float, float]

# Materials
GROUND, PAVEMENT, KERB, WALL, ROOF, LEAF, BARK, PLAIN, PAINT, CAR_SIDE, GLASS, TYRE, SIGN = range(
    13
)


@dataclass(frozen=True)
class Face:
    """One surface with its own texture frame.

    Attributes:
        material: one of the constants above.
        origin: (3,) world point where u = v = 0.
        u_axis: (3,) unit vector, world.
        v_axis: (3,) unit vector, world.
        size: extent along u and v, in metres.
        color: linear RGB in [0, 1].
        accent: second colour, linear RGB.
        params: four numbers whose meaning depends on the material.
        seed: of its pattern.
    """

    material: int
    origin: Array = field(default_factory=lambda: np.zeros(3))
    u_axis: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    v_axis: Array = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    size: tuple[float, float] = (1.0, 1.0)
    color: Color = (0.5, 0.5, 0.5)
    accent: Color = (0.5, 0.5, 0.5)
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    seed: int = 0


def as_color(rgb: Array) -> Color:
    """Turn (3,) linear RGB to a colour, within what surfaces can have."""
    red, green, blue = (float(value) for value in np.clip(rgb, 0.008, 0.8))
    return red, green, blue


class Faces(NamedTuple):
    """The faces as arrays, one row each; see ``Face``."""

    material: NDArray[np.int64]
    origin: NDArray[np.float32]
    u_axis: NDArray[np.float32]
    v_axis: NDArray[np.float32]
    size: NDArray[np.float32]
    color: NDArray[np.float32]
    accent: NDArray[np.float32]
    params: NDArray[np.float32]
    seed: NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """Triangles (T, 3) over vertices (V, 3) in world metres; (T,) face of each triangle."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    triangle_face: NDArray[np.int32]
    faces: Faces

    def normals(self) -> NDArray[np.float32]:
        """Return the (T, 3) unit normals, of either sign."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return np.asarray(cross / np.maximum(length, 1e-12), np.float32)


class MeshBuilder:
    """Collect the triangles of all objects."""

    def __init__(self) -> None:
        self._vertices: list[Array] = []
        self._triangles: list[NDArray[np.int64]] = []
        self._triangle_face: list[NDArray[np.int64]] = []
        self._faces: list[Face] = []
        self._num_vertices = 0

    def add(self, face: Face, vertices: Array, triangles: NDArray[np.int64]) -> None:
        """Add (T, 3) triangles over (V, 3) world vertices, all of one face."""
        self._faces.append(face)
        self._vertices.append(vertices)
        self._triangles.append(np.asarray(triangles) + self._num_vertices)
        self._triangle_face.append(np.full(len(triangles), len(self._faces) - 1))
        self._num_vertices += len(vertices)

    def add_polygon(self, face: Face, corners: Array) -> None:
        """Add a convex polygon of (K, 3) world corners."""
        fan = [[0, k, k + 1] for k in range(1, len(corners) - 1)]
        self.add(face, corners, np.array(fan))

    def build(self) -> Mesh:
        """Return everything that was added."""
        columns = [
            np.array([getattr(face, name) for face in self._faces]) for name in Faces._fields
        ]
        return Mesh(
            np.concatenate(self._vertices).astype(np.float32),
            np.concatenate(self._triangles).astype(np.uint32),
            np.concatenate(self._triangle_face).astype(np.int32),
            _faces_from(columns),
        )


def _faces_from(columns: list[NDArray[Any]]) -> Faces:
    material, seed = columns[0].astype(np.int64), columns[-1].astype(np.int64)
    looks = [look.astype(np.float32) for look in columns[1:-1]]
    origin, u_axis, v_axis, size, color, accent, params = looks
    return Faces(material, origin, u_axis, v_axis, size, color, accent, params, seed)


@dataclass(frozen=True)
class Placement:
    """Where an object stands: its local axes are x right, y up, z front.

    Attributes:
        origin: (3,) world point of its foot.
        yaw: direction of its front, in radians; 0 is world +z.
    """

    origin: Array
    yaw: float

    def axes(self) -> tuple[Array, Array, Array]:
        """Return the world directions of right, up and front; right is seen from the object."""
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        return np.array([cos, 0.0, -sin]), np.array([0.0, -1.0, 0.0]), np.array([sin, 0.0, cos])

    def world(self, local: Array) -> Array:
        """Map (..., 3) local points to the world."""
        return np.asarray(self.origin + local @ np.stack(self.axes()))


def box(low: Array, high: Array) -> list[tuple[Array, Array, Array]]:
    """Return the sides and the top of a local box as (corner, u vector, v vector)."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    up = np.array([0.0, y1 - y0, 0.0])
    right, front = np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, 0.0, z1 - z0])
    return [
        (np.array([x0, y0, z1]), right, up),
        (np.array([x1, y0, z1]), -front, up),
        (np.array([x1, y0, z0]), -right, up),
        (np.array([x0, y0, z0]), front, up),
        (np.array([x0, y1, z1]), right, -front),
    ]
