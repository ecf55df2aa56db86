"""Light on what the rays hit: sun, sky, gloss, haze. Linear RGB, 1 is white."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.facades import roof_color, wall_color
from laser_slam.datasets.synthetic.ground import ground_color
from laser_slam.datasets.synthetic.hit import Hit, make_hit
from laser_slam.datasets.synthetic.kernels import inlined, kernel
from laser_slam.datasets.synthetic.mesh import KERB, LEAF, ROOF, WALL
from laser_slam.datasets.synthetic.objects import leaf_color, object_color
from laser_slam.datasets.synthetic.textures import CLOUDS, noise
from laser_slam.datasets.synthetic.world import Scene

NOTHING = 0xFFFFFFFF  # what Open3D calls the triangle of a ray that hits none
SUN_COLOR = (2.45, 2.25, 1.90)
SKY_LIGHT = (0.46, 0.55, 0.70)
HAZE_COLOR = (0.66, 0.73, 0.82)


@kernel
def shade(
    scene: Scene,
    out: NDArray[np.float32],
    rays: NDArray[np.float32],
    triangles: NDArray[np.uint32],
    depth: NDArray[np.float32],
    camera: NDArray[np.float64],
) -> None:
    """Colour rays.

    Args:
        scene: the world.
        out: (N, 3) takes the linear RGB.
        rays: (N, 6) origins and directions, in world axes.
        triangles: (N,) what they hit.
        depth: (N,) how far, in lengths of the direction.
        camera: (2, 3) change of the direction to the next pixel, to the right and down.
    """
    for i in range(len(rays)):
        origin = float(rays[i, 0]), float(rays[i, 1]), float(rays[i, 2])
        ray = (*origin, float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5]))
        if triangles[i] == NOTHING:
            red, green, blue = sky_color(scene, ray[3], ray[4], ray[5])
        else:
            hit = make_hit(scene, ray, camera, int(triangles[i]), float(depth[i]))
            red, green, blue = _lit(scene, hit, ray)
        out[i, 0], out[i, 1], out[i, 2] = red, green, blue


@inlined
def sky_color(scene: Scene, dx: float, dy: float, dz: float) -> Any:
    """Return the colour of the sky in a direction: a gradient, clouds, a glow about the sun."""
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    up = max(-dy / length, 0.0)
    share = 1.0 - (1.0 - min(up * 1.25, 1.0)) ** 2.2
    red = HAZE_COLOR[0] + share * (0.13 - HAZE_COLOR[0])
    green = HAZE_COLOR[1] + share * (0.28 - HAZE_COLOR[1])
    blue = HAZE_COLOR[2] + share * (0.62 - HAZE_COLOR[2])
    flat = 1.0 / ((up + 0.09) * length)  # where the ray meets the layer of clouds
    x, z = dx * flat * 0.055, dz * flat * 0.055
    footprint = 0.00025 / (up + 0.09) ** 2
    cloud = noise(scene.textures, CLOUDS, x, z, footprint)
    cloud += 0.45 * noise(scene.textures, CLOUDS, 3.1 * x + 0.3, 3.1 * z, 3.1 * footprint)
    cover = min(max(0.12 + 0.55 * cloud, 0.0), 1.0) * min(up / 0.06, 1.0)
    white = 0.88 - 0.10 * max(cloud - 1.0, 0.0)
    red, green, blue = (
        red + cover * (white - red),
        green + cover * (white - green),
        blue + cover * (white * 1.02 - blue),
    )
    toward = (dx * scene.sun[0] + dy * scene.sun[1] + dz * scene.sun[2]) / length
    glow = 0.25 * max(toward, 0.0) ** 12
    return red + glow, green + 0.95 * glow, blue + 0.8 * glow


@inlined
def _lit(scene: Scene, hit: Hit, ray: Any) -> Any:
    material = scene.faces.material[hit.face]
    red, green, blue, gloss = _albedo(scene, hit, material)
    nx, ny, nz = _shading_normal(scene, hit, material)
    facing = nx * scene.sun[0] + ny * scene.sun[1] + nz * scene.sun[2]
    if material == LEAF:
        facing = 0.75 * facing + 0.25  # light goes through leaves
    sun = max(facing, 0.0)
    if material <= KERB:
        sun *= _sunlit(scene, hit)
    ambient = 0.70 - 0.30 * ny  # more from above
    if material == WALL:
        ambient *= 0.75 + 0.25 * min(max(hit.v, 0.0) / 2.5, 1.0)
    red *= SUN_COLOR[0] * sun + SKY_LIGHT[0] * ambient
    green *= SUN_COLOR[1] * sun + SKY_LIGHT[1] * ambient
    blue *= SUN_COLOR[2] * sun + SKY_LIGHT[2] * ambient
    if gloss > 0.02:
        red, green, blue = _reflected(scene, hit, ray, (red, green, blue), gloss)
    length = np.sqrt(ray[3] ** 2 + ray[4] ** 2 + ray[5] ** 2)
    seen = np.exp(-scene.haze * hit.depth * length)
    return (
        red * seen + HAZE_COLOR[0] * (1 - seen),
        green * seen + HAZE_COLOR[1] * (1 - seen),
        blue * seen + HAZE_COLOR[2] * (1 - seen),
    )


@inlined
def _albedo(scene: Scene, hit: Hit, material: int) -> Any:
    if material <= KERB:
        red, green, blue = ground_color(scene, hit, material)
    elif material == WALL:
        return wall_color(scene, hit)
    elif material == ROOF:
        red, green, blue = roof_color(scene, hit)
    elif material == LEAF:
        red, green, blue = leaf_color(scene, hit)
    else:
        return object_color(scene, hit, material)
    return red, green, blue, 0.0


@inlined
def _shading_normal(scene: Scene, hit: Hit, material: int) -> Any:
    """Round crowns off: their facets take the normal of the whole crown, half and half."""
    radius = scene.faces.params[hit.face, 0]
    if material != LEAF or radius <= 0:
        return hit.nx, hit.ny, hit.nz
    origin, share = scene.faces.origin, 0.8 / radius
    nx = 0.5 * hit.nx + share * (hit.x - origin[hit.face, 0])
    ny = 0.5 * hit.ny + share * (hit.y - origin[hit.face, 1])
    nz = 0.5 * hit.nz + share * (hit.z - origin[hit.face, 2])
    length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
    return nx / length, ny / length, nz / length


@inlined
def _sunlit(scene: Scene, hit: Hit) -> Any:
    """Return the share of the sun that reaches the ground, from the raster, bilinearly."""
    frame = scene.sunlit_frame
    fx, fz = (hit.x - frame[0]) / frame[2] - 0.5, (hit.z - frame[1]) / frame[2] - 0.5
    x0, z0 = int(np.floor(fx)), int(np.floor(fz))
    rows, columns = scene.sunlit.shape
    if x0 < 0 or z0 < 0 or x0 + 1 >= columns or z0 + 1 >= rows:
        return 1.0
    wx, wz = fx - x0, fz - z0
    upper = scene.sunlit[z0, x0] * (1 - wx) + scene.sunlit[z0, x0 + 1] * wx
    lower = scene.sunlit[z0 + 1, x0] * (1 - wx) + scene.sunlit[z0 + 1, x0 + 1] * wx
    return (upper * (1 - wz) + lower * wz) / 255.0


@inlined
def _reflected(scene: Scene, hit: Hit, ray: Any, color: Any, gloss: float) -> Any:
    """Add the sky's mirror image: what glass and paint show at a slant."""
    dx, dy, dz = ray[3], ray[4], ray[5]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    facing = (dx * hit.nx + dy * hit.ny + dz * hit.nz) / length
    fresnel = 0.06 + 0.94 * (1.0 - min(-facing, 1.0)) ** 5
    share = gloss * min(fresnel + 0.04, 0.7)
    up = -(dy / length - 2 * facing * hit.ny)
    # below this height a mirror shows the houses across the street
    light = min(max((up - 0.18) / 0.15, 0.0), 1.0)
    mirror = 0.12 + 0.62 * light
    keep = 1.0 - 0.5 * share
    return (
        color[0] * keep + mirror * share,
        color[1] * keep + mirror * 1.04 * share,
        color[2] * keep + mirror * 1.10 * share,
    )
