"""The ground: a height field through the path's heights, with kerbs and pavements on it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from laser_slam.datasets.synthetic.mesh import GROUND, KERB, PAVEMENT, Face, MeshBuilder
from laser_slam.datasets.synthetic.paths import CAMERA_HEIGHT_M
from laser_slam.datasets.synthetic.streets import (
    HALF_ROAD_M,
    PAVEMENT_M,
    Streets,
)
from laser_slam.errors import DatasetError

Array = NDArray[np.float64]

MARGIN_M = 130.0  # ground beyond the streets; haze and trees hide its end
CELL_M = 2.0
KERB_M = 0.12
HEIGHT_TOLERANCE_M = 0.4
MAX_LEVELLING_M = 4.0


@dataclass(frozen=True)
class Terrain:
    """A raster over the world.

    Attributes:
        ground_y: (rows, columns) world y of the ground (down is positive) at cell corners.
        distance: (rows, columns) metres to the nearest centre line.
        origin: (2,) plan coordinates of the raster's first corner.
    """

    ground_y: Array
    distance: Array
    origin: Array

    def at(self, plan: Array) -> Array:
        """Return the world y of the ground at (..., 2) plan points."""
        return self._sample(self.ground_y, plan)

    def street_distance(self, plan: Array) -> Array:
        """Return the metres from (..., 2) plan points to the nearest centre line, coarsely."""
        return self._sample(self.distance, plan)

    def _sample(self, raster: Array, plan: Array) -> Array:
        cells = (plan - self.origin) / CELL_M
        at = np.stack([cells[..., 1], cells[..., 0]])
        return np.asarray(map_coordinates(raster, at, order=1, mode="nearest"))


def make_terrain(world_from_cam: Array, streets: Streets, seed: int) -> Terrain:
    """Draw the ground 1.65 m below the cameras, with low hills far from streets.

    Where the path comes by twice at different heights, the ground lies between.
    """
    cameras = world_from_cam[:, [0, 2], 3]
    everything = np.concatenate([streets.points, cameras])
    origin = everything.min(axis=0) - MARGIN_M
    columns, rows = np.ceil((everything.max(axis=0) + MARGIN_M - origin) / CELL_M).astype(int) + 1
    shape = (int(rows), int(columns))
    heights = world_from_cam[:, 1, 3] + CAMERA_HEIGHT_M
    ground = _interpolated(shape, (cameras - origin) / CELL_M, heights)
    is_street = np.ones(shape, bool)
    cells = np.round((streets.points - origin) / CELL_M).astype(int)
    is_street[cells[:, 1], cells[:, 0]] = False
    distance = np.asarray(distance_transform_edt(is_street)) * CELL_M
    waves = cv2.GaussianBlur(np.random.default_rng((seed, 3)).standard_normal(shape), (0, 0), 9.0)
    waves *= np.clip((distance - 20.0) * 0.03, 0.0, 1.5) / max(float(waves.std()), 1e-9)
    return Terrain(ground + waves, distance, origin)


def level_path(world_from_cam: Array, terrain: Terrain) -> Array:
    """Lift or lower the cameras that are not 1.65 m above the ground, give or take 0.4 m.

    Satellite heights drift: the second passage of a place may be given metres above the first.

    Raises:
        DatasetError: a camera is so far off that the path must cross itself on a bridge.
    """
    too_high = terrain.at(world_from_cam[:, [0, 2], 3]) - world_from_cam[:, 1, 3] - CAMERA_HEIGHT_M
    frame = int(np.argmax(np.abs(too_high)))
    if abs(too_high[frame]) > MAX_LEVELLING_M:
        raise DatasetError(
            f"the camera path passes the place of frame {frame} at heights that differ by "
            f"{2 * abs(too_high[frame]):.0f} m; one ground cannot hold a bridge: shorten the path"
        )
    out = world_from_cam.copy()
    out[:, 1, 3] += np.sign(too_high) * np.maximum(np.abs(too_high) - HEIGHT_TOLERANCE_M, 0.0)
    return out


def _interpolated(shape: tuple[int, int], cells: Array, values: Array) -> Array:
    """Spread scattered values over a raster, smoothly, the near ones first."""
    total, weight = np.zeros(shape), np.zeros(shape)
    corner = np.floor(cells).astype(np.int64)
    for dx, dz in ((0, 0), (1, 0), (0, 1), (1, 1)):
        at = corner + np.array([dx, dz])
        share = np.prod(1.0 - np.abs(cells - at), axis=1)
        np.add.at(total, (at[:, 1], at[:, 0]), values * share)
        np.add.at(weight, (at[:, 1], at[:, 0]), share)
    out = np.full(shape, values.mean())
    for sigma_m in (120.0, 40.0, 14.0, 6.0, 2.5):
        size = 2 * round(sigma_m / CELL_M) + 1  # three box filters are nearly a Gaussian
        t, w = total.copy(), weight.copy()
        for _ in range(3):
            t, w = cv2.blur(t, (size, size)), cv2.blur(w, (size, size))
        trust = w / (w + 0.02 * max(float(w.max()), 1e-12))
        out += trust * (t / np.maximum(w, 1e-12) - out)
    return out


def add_ground(builder: MeshBuilder, terrain: Terrain) -> None:
    """Add the height field as far as the margin reaches."""
    rows, columns = terrain.ground_y.shape
    grid_z, grid_x = np.mgrid[0:rows, 0:columns]
    x = terrain.origin[0] + CELL_M * grid_x
    z = terrain.origin[1] + CELL_M * grid_z
    vertices = np.stack([x, terrain.ground_y, z], axis=-1).reshape(-1, 3)
    used = (terrain.distance < MARGIN_M)[:-1, :-1]
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None])[used]
    quads = np.stack([a, a + 1, a + columns + 1, a, a + columns + 1, a + columns], axis=1)
    needed, triangles = np.unique(quads.reshape(-1, 3), return_inverse=True)
    builder.add(Face(GROUND), vertices[needed], triangles.reshape(-1, 3))


def add_pavements(builder: MeshBuilder, terrain: Terrain, streets: Streets) -> None:
    """Add a kerb and a pavement on both sides of every street, open where streets meet."""
    tree = cKDTree(streets.points)
    for chain in range(int(streets.chain.max()) + 1):
        rows = np.flatnonzero(streets.chain == chain)
        at = np.interp(np.arange(0, len(rows) - 0.999, 0.5), np.arange(len(rows)), rows)
        lower = np.minimum(at.astype(int), rows[-1] - 1)
        share = (at - lower)[:, None]
        line = streets.points[lower] * (1 - share) + streets.points[lower + 1] * share
        along = streets.tangents[lower] * (1 - share) + streets.tangents[lower + 1] * share
        for side in (-1.0, 1.0):
            right = side * np.stack([along[:, 1], -along[:, 0]], axis=1)
            _add_pavement(builder, terrain, tree, (line, right))


def _add_pavement(
    builder: MeshBuilder, terrain: Terrain, tree: cKDTree, line: tuple[Array, Array]
) -> None:
    points, right = line
    offsets = (HALF_ROAD_M, HALF_ROAD_M, HALF_ROAD_M + 0.15, HALF_ROAD_M + PAVEMENT_M)
    rails = [points + offset * right for offset in (*offsets, offsets[-1])]
    # A bend folds the rails on its inner side, and other streets cross: leave those pieces out.
    is_open = [tree.query(rails[k])[0] < offsets[k] - 0.3 for k in (0, 3)]
    inner, outer = (~(bad[:-1] | bad[1:]) for bad in is_open)
    raised = terrain.at(rails[3]) * 0.5 + terrain.at(rails[0]) * 0.5
    top = np.minimum(raised, terrain.at(rails[0])) - KERB_M
    heights = [terrain.at(rails[0]) + 0.1, top, top, top - 0.03, top + 0.6]
    corners = [np.stack([r[:, 0], y, r[:, 1]], 1) for r, y in zip(rails, heights, strict=True)]
    folded = inner & ~outer  # the pavement's outer rail is pulled in to the kerb's back
    for k, material in ((0, KERB), (1, KERB), (2, PAVEMENT), (3, KERB)):
        _add_strip(builder, Face(material), corners[k], corners[k + 1], inner & (outer | (k < 2)))
    narrow = points + (HALF_ROAD_M + 0.9) * right
    edge = np.stack([narrow[:, 0], top - 0.02, narrow[:, 1]], axis=1)
    _add_strip(builder, Face(PAVEMENT), corners[2], edge, folded)


def _add_strip(
    builder: MeshBuilder, face: Face, first: Array, second: Array, used: NDArray[np.bool_]
) -> None:
    a = np.flatnonzero(used)
    if len(a):
        b = a + len(first)
        triangles = np.stack([a, a + 1, b + 1, a, b + 1, b], axis=1).reshape(-1, 3)
        builder.add(face, np.concatenate([first, second]), triangles)
