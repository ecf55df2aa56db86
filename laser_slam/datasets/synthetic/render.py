"""Frames of the world: one ray a pixel, more where geometry has edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.camera import rays as pixel_rays
from laser_slam.datasets.synthetic.shading import NOTHING, shade
from laser_slam.datasets.synthetic.world import World
from laser_slam.dependencies import import_open3d

Array = NDArray[np.float64]
Float = NDArray[np.float32]

EXPOSURE = 0.78
GAMMA = 1.0 / 2.2
EDGE_BEND = 0.02  # step of inverse depth beyond a plane's, in the pixel's own
# where the extra rays of an edge's pixel go, in pixels, beside the one in its middle
OFFSETS = ((-0.35, -0.15), (0.30, -0.30), (0.05, 0.40))


class Renderer:
    """A camera in a world.

    Args:
        world: what it sees.
        intrinsics: (3, 3) in pixels.
        size: (height, width) in pixels.
    """

    def __init__(self, world: World, intrinsics: Array, size: tuple[int, int]) -> None:
        self._world = world
        self._size = size
        self._directions = pixel_rays(intrinsics, *size).reshape(-1, 3).astype(np.float32)
        self._step = np.diag([1.0 / intrinsics[0, 0], 1.0 / intrinsics[1, 1], 0.0])[:2]
        self._tensor = import_open3d().core.Tensor

    def depth(self, world_from_cam: Array) -> Float:
        """Return (H, W) depth z in metres, NaN in the sky."""
        triangles, depth = self._cast(self._rays(world_from_cam, self._directions))
        return np.where(triangles == NOTHING, np.float32(np.nan), depth).reshape(self._size)

    def image(self, world_from_cam: Array, noise: float, rng: np.random.Generator) -> Any:
        """Return the (H, W, 3) RGB uint8 image, with sensor noise of ``noise`` grey levels."""
        linear = self._linear(world_from_cam)
        if noise > 0:
            levels = np.float32(noise) * rng.standard_normal(linear.shape, np.float32)
        else:
            levels = np.zeros_like(linear)
        return _developed(linear, levels)

    def _linear(self, world_from_cam: Array) -> Float:
        rays = self._rays(world_from_cam, self._directions)
        triangles, depth = self._cast(rays)
        camera = self._step @ world_from_cam[:3, :3].T
        color = np.empty((len(rays), 3), np.float32)
        shade(self._world.scene, color, rays, triangles, depth, camera)
        edges = np.flatnonzero(
            _edges(
                self._world.scene.triangle_face,
                triangles.reshape(self._size),
                depth.reshape(self._size),
            )
        )
        if len(edges):
            more = self._around(edges)
            rays = self._rays(world_from_cam, more)
            triangles, depth = self._cast(rays)
            extra = np.empty((len(rays), 3), np.float32)
            shade(self._world.scene, extra, rays, triangles, depth, camera)
            total = color[edges] + extra.reshape(len(edges), len(OFFSETS), 3).sum(axis=1)
            color[edges] = total / np.float32(len(OFFSETS) + 1)
        return color.reshape(*self._size, 3)

    def _around(self, pixels: NDArray[np.int64]) -> Float:
        offsets = (np.array(OFFSETS) @ self._step).astype(np.float32)
        return (self._directions[pixels][:, None] + offsets).reshape(-1, 3)

    def _rays(self, world_from_cam: Array, directions: Float) -> Float:
        rays = np.empty((len(directions), 6), np.float32)
        _turn(rays, directions, np.ascontiguousarray(world_from_cam))
        return rays

    def _cast(self, rays: Float) -> tuple[NDArray[np.uint32], Float]:
        """Return (N,) triangles and (N,) distances in lengths of the direction, which is z."""
        result = self._world.raycaster.cast_rays(self._tensor(rays), nthreads=1)
        return result["primitive_ids"].numpy(), result["t_hit"].numpy()


@njit(cache=True, nogil=True)
def _turn(rays: Any, directions: Any, world_from_cam: Any) -> None:
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        for k in range(3):
            rays[i, k] = world_from_cam[k, 3]
            turned = world_from_cam[k, 0] * x + world_from_cam[k, 1] * y
            rays[i, 3 + k] = turned + world_from_cam[k, 2] * z


@njit(cache=True, nogil=True)
def _edges(triangle_face: Any, triangles: Any, depth: Any) -> Any:
    """Mark (H, W) pixels where another surface begins or depth departs from a plane."""
    height, width = triangles.shape
    out = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            above, below = max(y - 1, 0), min(y + 1, height - 1)
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            here = triangles[y, x]
            if (
                here == triangles[above, x]
                and here == triangles[below, x]
                and here == triangles[y, left]
                and here == triangles[y, right]
            ):
                continue
            out[y, x] = _is_edge(triangle_face, triangles, depth, (y, x, above, below)) or (
                _is_edge(triangle_face, triangles.T, depth.T, (x, y, left, right))
            )
    return out


@njit(cache=True, nogil=True)
def _is_edge(triangle_face: Any, triangles: Any, depth: Any, at: Any) -> Any:
    y, x, before, after = at
    here, first, last = triangles[y, x], triangles[before, x], triangles[after, x]
    nothing = (here == NOTHING) + (first == NOTHING) + (last == NOTHING)
    if nothing:
        return nothing < 3
    face = triangle_face[here]
    if face != triangle_face[first] or face != triangle_face[last]:
        return True
    bend = 1.0 / depth[before, x] + 1.0 / depth[after, x] - 2.0 / depth[y, x]
    return abs(bend) * depth[y, x] > EDGE_BEND


@njit(cache=True, nogil=True)
def _developed(linear: Any, levels: Any) -> Any:
    """Turn linear light to grey levels: exposure, a soft shoulder, gamma, noise."""
    out = np.empty(linear.shape, np.uint8)
    flat, noise, target = linear.ravel(), levels.ravel(), out.ravel()
    for i in range(len(flat)):
        light = EXPOSURE * flat[i]
        if light > 0.7:
            light = 0.7 + 0.3 * (1.0 - np.exp(-(light - 0.7) / 0.3))
        level = 255.0 * max(light, 0.0) ** GAMMA + noise[i]
        target[i] = np.uint8(min(max(level + 0.5, 0.0), 255.0))
    return out
