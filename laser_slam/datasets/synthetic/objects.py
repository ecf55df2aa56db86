"""Looks of plants, cars and street furniture. Linear RGB."""

from __future__ import annotations

from typing import Any

import numpy as np

from laser_slam.datasets.synthetic.hit import Hit, solid_noise
from laser_slam.datasets.synthetic.kernels import inlined
from laser_slam.datasets.synthetic.mesh import BARK, CAR_SIDE, GLASS, PLAIN, SIGN, TYRE, Faces
from laser_slam.datasets.synthetic.textures import CLOUDS, GRAIN, LEAVES, band, hash01
from laser_slam.datasets.synthetic.world import Scene


@inlined
def _base(faces: Faces, face: int) -> Any:
    return faces.color[face, 0], faces.color[face, 1], faces.color[face, 2]


@inlined
def leaf_color(scene: Scene, hit: Hit) -> Any:
    """Return the albedo of foliage: specks of leaves, clumps, darker inside and below."""
    faces, face = scene.faces, hit.face
    shift = hash01(faces.seed[face], 1, 31)
    leaves = solid_noise(scene.textures, LEAVES, hit, 1.7, shift)
    clumps = solid_noise(scene.textures, LEAVES, hit, 7.3, shift + 0.4)
    tone = 1.0 + 0.36 * leaves + 0.24 * clumps
    radius = faces.params[face, 0]
    if radius > 0:
        height = (faces.origin[face, 1] - hit.y) / radius  # -1 below the crown, 1 on top
        tone *= min(max(0.80 + 0.22 * height, 0.45), 1.1)
    tone = max(tone, 0.14)
    base = _base(faces, face)
    warm = 1.0 + 0.10 * clumps
    return base[0] * tone * warm, base[1] * tone, base[2] * tone


@inlined
def object_color(scene: Scene, hit: Hit, material: int) -> Any:
    """Return (red, green, blue, gloss) of bark, metal, cars and signs."""
    if material == SIGN:
        return _sign(scene, hit)
    if material == CAR_SIDE:
        return _car_side(scene, hit)
    if material == TYRE:
        return _tyre(hit, scene)
    if material == GLASS:
        return 0.015, 0.018, 0.02, 1.0
    base = _base(scene.faces, hit.face)
    if material == BARK or material == PLAIN:
        tone = 1.0 + 0.12 * solid_noise(scene.textures, GRAIN, hit, 1.1, 0.2)
        tone += (0.2 if material == BARK else 0.05) * solid_noise(
            scene.textures, CLOUDS, hit, 1.9, 0.6
        )
        tone = max(tone, 0.2)
        return base[0] * tone, base[1] * tone, base[2] * tone, 0.0
    return _car_end(scene, hit)


@inlined
def _car_end(scene: Scene, hit: Hit) -> Any:
    """Return paint, with lamps and a number plate at the front and the rear."""
    faces, face = scene.faces, hit.face
    base = _base(faces, face)
    red, green, blue, gloss = base[0], base[1], base[2], 0.25
    end, width, height = faces.params[face, 0], faces.size[face, 0], faces.size[face, 1]
    if end > 0:
        middle = abs(hit.u - 0.5 * width)
        level = hit.v / max(height, 1e-3)
        if end > 1:
            level = 1.0 - level
        lamp = band(middle, 0.5 * width - 0.42, 0.5 * width - 0.05, hit.du)
        lamp *= band(level, 0.45, 0.95, hit.dv / height)
        plate = band(middle, -0.01, 0.26, hit.du) * band(level, 0.15, 0.5, hit.dv / height)
        glow = (0.45, 0.45, 0.42) if end < 1.5 else (0.32, 0.015, 0.01)
        red = red * (1 - lamp) + glow[0] * lamp
        green = green * (1 - lamp) + glow[1] * lamp
        blue = blue * (1 - lamp) + glow[2] * lamp
        red, green, blue = (
            red * (1 - plate) + 0.5 * plate,
            green * (1 - plate) + 0.5 * plate,
            blue * (1 - plate) + 0.42 * plate,
        )
    return red, green, blue, gloss


@inlined
def _car_side(scene: Scene, hit: Hit) -> Any:
    faces, face = scene.faces, hit.face
    length, height = faces.size[face, 0], faces.size[face, 1]
    shoulder = faces.params[face, 0]
    base = _base(faces, face)
    u, v = hit.u / length, hit.v
    sill = band(v, 0.0, 0.36, hit.dv)
    front = 0.29 + 0.16 * (v - shoulder) / (height - shoulder) + 0.02  # slope of the windscreen
    glass = band(v, shoulder + 0.04, height - 0.09, hit.dv)
    glass *= band(u, front, 0.80 - 0.09 * (v - shoulder) / (height - shoulder), hit.du / length)
    glass *= 1.0 - band(u, 0.52, 0.545, hit.du / length)
    door = band(u, 0.325, 0.331, hit.du / length) + band(u, 0.53, 0.536, hit.du / length)
    door += band(u, 0.73, 0.736, hit.du / length)
    door *= band(v, 0.36, shoulder + 0.02, hit.dv)
    handle = band(v, shoulder - 0.12, shoulder - 0.08, hit.dv)
    handle *= band(u, 0.47, 0.51, hit.du / length) + band(u, 0.68, 0.72, hit.du / length)
    arch = _disc(u * length - 0.185 * length, v - 0.22 * height, 0.28 * height, hit)
    arch = max(arch, _disc(u * length - 0.815 * length, v - 0.22 * height, 0.28 * height, hit))
    dark = min(max(max(0.8 * sill, arch), 0.7 * max(door, handle)), 1.0)
    keep = (1 - dark) * (1 - glass)
    hold = 0.015 * (1 - keep)
    return (
        base[0] * keep + hold,
        base[1] * keep + hold,
        base[2] * keep + 1.1 * hold,
        0.8 * glass + 0.2 * keep,
    )


@inlined
def _disc(x: float, y: float, radius: float, hit: Hit) -> Any:
    width = 0.5 * (hit.du + hit.dv) + 1e-4
    return min(max((radius - np.sqrt(x * x + y * y)) / width + 0.5, 0.0), 1.0)


@inlined
def _tyre(hit: Hit, scene: Scene) -> Any:
    radius = scene.faces.size[hit.face, 0]
    rim = _disc(hit.u, hit.v, 0.66 * radius, hit)
    hub = _disc(hit.u, hit.v, 0.16 * radius, hit)
    spokes = 0.55 + 0.45 * np.cos(5.0 * np.arctan2(hit.v, hit.u))
    fade = max(0.0, 1.0 - hit.du / (0.4 * radius))
    spokes = 0.55 + (spokes - 0.55) * fade
    tone = 0.018 * (1 - rim) + rim * (0.05 + 0.30 * spokes) * (1 - hub) + 0.3 * hub
    return tone, tone, tone * 1.03, 0.0


@inlined
def _sign(scene: Scene, hit: Hit) -> Any:
    """Return a sign: 0 round with a red ring, 1 blue, 2 yellow diamond, 3 a board with words."""
    faces, face = scene.faces, hit.face
    kind, seed = int(faces.params[face, 0]), faces.seed[face]
    u, v = hit.u / faces.size[face, 0] - 0.5, hit.v / faces.size[face, 1] - 0.5
    column, row = int(np.floor((u + 0.5) * 9)), int(np.floor((v + 0.5) * 9))
    ink = 1.0 if hash01(column, row, seed) < 0.5 else 0.0
    ink *= max(0.0, 1.0 - 9.0 * hit.du / faces.size[face, 0])
    ink *= band(abs(u), 0.0, 0.26, hit.du) * band(abs(v), 0.0, 0.22, hit.dv)
    if kind == 0:
        disc = _disc(u, v, 0.36, hit)
        return 0.45 + 0.15 * disc - 0.55 * ink, 0.02 + 0.56 * disc - 0.5 * ink, disc * 0.55, 0.0
    if kind == 1:
        return 0.02 + 0.55 * ink, 0.07 + 0.5 * ink, 0.38 + 0.2 * ink, 0.0
    if kind == 2:
        return 0.60 - 0.55 * ink, 0.42 - 0.38 * ink, 0.03, 0.0
    edge = band(max(abs(u), abs(v)), 0.0, 0.45, hit.du)
    return 0.6 - 0.55 * ink * edge, 0.6 - 0.5 * ink * edge, 0.58 - 0.3 * ink, 0.0
