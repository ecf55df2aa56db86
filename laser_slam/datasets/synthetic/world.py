"""The street world: one triangle mesh, its streets, its textures and its sunlight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.layout import Layout
from laser_slam.datasets.synthetic.mesh import Faces, Mesh, MeshBuilder
from laser_slam.datasets.synthetic.streets import Streets, make_streets
from laser_slam.datasets.synthetic.terrain import (
    Terrain,
    add_ground,
    add_pavements,
    level_path,
    make_terrain,
)
from laser_slam.datasets.synthetic.textures import Textures, make_textures
from laser_slam.dependencies import import_open3d

Array = NDArray[np.float64]

SUN_HEIGHT = 0.85  # radians above the horizon
SHADOW_CELL_M = 0.25
MAX_SHADOW_CELLS = 40_000_000
SHADOW_REACH_M = 24.0  # shadows on the ground are kept up to here from a street


class Scene(NamedTuple):
    """All that the shading needs to know, as arrays.

    Attributes:
        faces: looks of the surfaces.
        triangle_face: (T,) face of each triangle.
        normals: (T, 3) unit normals.
        streets: for what is painted on the ground.
        textures: noise.
        sunlit: (rows, columns) how much of the sun reaches the ground, 0-255.
        sunlit_frame: (3,) plan x and z of its corner, and its cell, metres.
        sun: (3,) unit vector towards the sun.
        haze: extinction per metre.
    """

    faces: Faces
    triangle_face: NDArray[np.int32]
    normals: NDArray[np.float32]
    streets: Streets
    textures: Textures
    sunlit: NDArray[np.uint8]
    sunlit_frame: Array
    sun: Array
    haze: float


@dataclass(frozen=True)
class World:
    """A built world.

    Attributes:
        raycaster: Open3D's scene of the mesh.
        scene: what the mesh looks like.
        world_from_cam: (N, 4, 4) the path, levelled where it comes by twice at two heights.
    """

    raycaster: Any
    scene: Scene
    world_from_cam: Array


def build_world(world_from_cam: Array, seed: int, haze: float) -> World:
    """Build the world along a path; the same path and seed give the same world.

    Args:
        world_from_cam: (N, 4, 4) rigid, metres.
        seed: of everything in it.
        haze: extinction per metre.

    Raises:
        DatasetError: the path crosses itself on a bridge.
        DependencyError: Open3D cannot be loaded.
    """
    streets = make_streets(world_from_cam)
    terrain = make_terrain(world_from_cam, streets, seed)
    builder = MeshBuilder()
    add_ground(builder, terrain)
    add_pavements(builder, terrain, streets)
    Layout(builder, terrain, streets, world_from_cam).furnish(seed)
    mesh = builder.build()
    raycaster = _raycaster(mesh)
    bearing = np.random.default_rng((seed, 5)).uniform(0, 2 * np.pi)
    level = np.cos(SUN_HEIGHT)
    sun = np.array([level * np.sin(bearing), -np.sin(SUN_HEIGHT), level * np.cos(bearing)])
    sunlit, frame = _sunlit_ground(raycaster, terrain, sun)
    scene = Scene(
        faces=mesh.faces,
        triangle_face=mesh.triangle_face,
        normals=mesh.normals(),
        streets=streets,
        textures=make_textures(seed),
        sunlit=sunlit,
        sunlit_frame=frame,
        sun=sun,
        haze=haze,
    )
    return World(raycaster, scene, level_path(world_from_cam, terrain))


def _raycaster(mesh: Mesh) -> Any:
    o3d = import_open3d()
    raycaster = o3d.t.geometry.RaycastingScene()
    raycaster.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles))
    return raycaster


def _sunlit_ground(raycaster: Any, terrain: Terrain, sun: Array) -> tuple[NDArray[np.uint8], Array]:
    """Cast one ray to the sun from every cell of the ground near the streets."""
    rows, columns = terrain.ground_y.shape
    extent = np.array([rows - 1, columns - 1]) * 2.0
    cell = max(SHADOW_CELL_M, float(np.sqrt(extent.prod() / MAX_SHADOW_CELLS)))
    shape = (int(extent[0] / cell), int(extent[1] / cell))
    out = np.full(shape, 255, np.uint8)
    tensor = import_open3d().core.Tensor
    for first in range(0, shape[0], 256):  # a band at a time: the world may be large
        z, x = np.mgrid[first : min(first + 256, shape[0]), 0 : shape[1]]
        plan = terrain.origin + (np.stack([x, z], axis=-1).reshape(-1, 2) + 0.5) * cell
        near = np.flatnonzero(terrain.street_distance(plan) < SHADOW_REACH_M)
        if not len(near):
            continue
        height = terrain.at(plan[near]) - 0.16  # above the pavement
        origin = np.stack([plan[near, 0], height, plan[near, 1]], axis=1)
        rays = np.concatenate([origin, np.broadcast_to(sun, origin.shape)], axis=1)
        is_dark = raycaster.test_occlusions(tensor(rays.astype(np.float32))).numpy()
        band = np.full(len(plan), 255, np.uint8)
        band[near] = np.where(is_dark, 0, 255)
        out[first : first + 256] = band.reshape(x.shape)
    return out, np.array([*terrain.origin, cell])
