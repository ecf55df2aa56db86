"""What a ray has hit, with the pixel's footprint on it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from laser_slam.datasets.synthetic.kernels import inlined, kernel
from laser_slam.datasets.synthetic.textures import Textures, noise
from laser_slam.datasets.synthetic.world import Scene


class Hit(NamedTuple):
    """A point of a surface, seen by one pixel. Lengths are in metres, axes are the world's.

    Attributes:
        face: row of the faces.
        x: world x.
        y: world y, down.
        z: world z.
        nx: normal, turned to the viewer.
        ny: normal.
        nz: normal.
        u: along the face's first axis.
        v: along its second.
        du: extent of the pixel along u.
        dv: extent of the pixel along v.
        minor: the shorter side of the footprint.
        major: the longer side.
        mx: unit direction of the longer side.
        my: unit direction of the longer side.
        mz: unit direction of the longer side.
        depth: along the optical axis.
    """

    face: int
    x: float
    y: float
    z: float
    nx: float
    ny: float
    nz: float
    u: float
    v: float
    du: float
    dv: float
    minor: float
    major: float
    mx: float
    my: float
    mz: float
    depth: float


@inlined
def make_hit(scene: Scene, ray: Any, camera: Any, triangle: int, depth: float) -> Any:
    """Intersect the pixel's ray, and those of its neighbours, with the triangle's plane.

    Args:
        scene: the world.
        ray: (6,) origin and direction; the direction's z in camera axes is 1.
        camera: (2, 3) change of the direction from one pixel to the next, to the right and down.
        triangle: that was hit.
        depth: along the ray, in lengths of its direction.
    """
    nx = float(scene.normals[triangle, 0])
    ny = float(scene.normals[triangle, 1])
    nz = float(scene.normals[triangle, 2])
    dx, dy, dz = ray[3], ray[4], ray[5]
    facing = nx * dx + ny * dy + nz * dz
    if facing > 0:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    facing = min(facing, -0.02)  # at grazing angles the footprint would be without end
    right = (nx * camera[0, 0] + ny * camera[0, 1] + nz * camera[0, 2]) / facing
    ax = depth * (camera[0, 0] - right * dx)
    ay = depth * (camera[0, 1] - right * dy)
    az = depth * (camera[0, 2] - right * dz)
    down = (nx * camera[1, 0] + ny * camera[1, 1] + nz * camera[1, 2]) / facing
    bx = depth * (camera[1, 0] - down * dx)
    by = depth * (camera[1, 1] - down * dy)
    bz = depth * (camera[1, 2] - down * dz)
    a, b = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
    mx, my, mz = (ax / a, ay / a, az / a) if a > b else (bx / b, by / b, bz / b)
    x, y, z = ray[0] + depth * dx, ray[1] + depth * dy, ray[2] + depth * dz
    face = scene.triangle_face[triangle]
    faces = scene.faces
    ux, uy, uz = faces.u_axis[face, 0], faces.u_axis[face, 1], faces.u_axis[face, 2]
    vx, vy, vz = faces.v_axis[face, 0], faces.v_axis[face, 1], faces.v_axis[face, 2]
    px, py, pz = x - faces.origin[face, 0], y - faces.origin[face, 1], z - faces.origin[face, 2]
    u, v = px * ux + py * uy + pz * uz, px * vx + py * vy + pz * vz
    du = abs(ax * ux + ay * uy + az * uz) + abs(bx * ux + by * uy + bz * uz)
    dv = abs(ax * vx + ay * vy + az * vz) + abs(bx * vx + by * vy + bz * vz)
    return Hit(face, x, y, z, nx, ny, nz, u, v, du, dv, min(a, b), max(a, b), mx, my, mz, depth)


@kernel
def ground_noise(textures: Textures, kind: int, hit: Hit, tile: float, shift: float) -> Any:
    """Sample noise on the ground plan, averaged along the footprint's longer side."""
    taps = 4 if hit.major > 2.5 * hit.minor else 1
    footprint = max(hit.minor, hit.major / taps) / tile
    if footprint > 0.25:
        return 0.0
    # turned by an angle that no street has, so that tiles do not line up with them
    x, z = 0.891 * hit.x + 0.454 * hit.z, 0.891 * hit.z - 0.454 * hit.x
    sx, sz = 0.891 * hit.mx + 0.454 * hit.mz, 0.891 * hit.mz - 0.454 * hit.mx
    total = 0.0
    for tap in range(taps):
        along = hit.major * ((tap + 0.5) / taps - 0.5)
        at_x, at_z = (x + along * sx) / tile + shift, (z + along * sz) / tile - shift
        total += noise(textures, kind, at_x, at_z, footprint)
    return total / taps


@kernel
def face_noise(textures: Textures, kind: int, hit: Hit, tile: float, shift: float) -> Any:
    """Sample noise in the face's own (u, v) frame."""
    footprint = np.sqrt(max(hit.du, 1e-5) * max(hit.dv, 1e-5)) / tile
    footprint = max(footprint, 0.5 * max(hit.du, hit.dv) / tile)
    return noise(textures, kind, hit.u / tile + shift, hit.v / tile + 1.7 * shift, footprint)


@kernel
def solid_noise(textures: Textures, kind: int, hit: Hit, tile: float, shift: float) -> Any:
    """Sample noise on three planes and blend them by the normal: never stretched."""
    wx, wy, wz = hit.nx * hit.nx, hit.ny * hit.ny, hit.nz * hit.nz
    footprint = min(hit.major, 3.0 * hit.minor) / tile
    x, y, z = hit.x / tile + shift, hit.y / tile - shift, hit.z / tile + 0.5 * shift
    total = 0.0
    if wx > 0.08:
        total += wx * noise(textures, kind, z, y, footprint)
    if wy > 0.08:
        total += wy * noise(textures, kind, x, z, footprint)
    if wz > 0.08:
        total += wz * noise(textures, kind, x, y, footprint)
    return total / np.sqrt(wx * wx + wy * wy + wz * wz)
