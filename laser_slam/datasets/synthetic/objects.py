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
    leaves = solid_noise(scene.textures, LEAVES, hit, 1.5, shift)
    clumps = solid_noise(scene.textures, LEAVES, hit, 7.3, shift + 0.4)
    tone = 1.0 + 0.46 * leaves + 0.24 * clumps
    radius = faces.params[face, 0]
    if radius > 0:
        height = (faces.origin[face, 1] - hit.y) / radius  # -1 below the crown, 1 on top
        tone *= min(max(0.88 + 0.2 * height, 0.6), 1.12)
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
        return _screen(scene, hit)
    base = _base(scene.faces, hit.face)
    if material in (BARK, PLAIN):
        tone = 1.0 + 0.12 * solid_noise(scene.textures, GRAIN, hit, 1.1, 0.2)
        tone += (0.2 if material == BARK else 0.05) * solid_noise(
            scene.textures, CLOUDS, hit, 1.9, 0.6
        )
        tone = max(tone, 0.2)
        return base[0] * tone, base[1] * tone, base[2] * tone, 0.0
    return _car_end(scene, hit)


@inlined
def _screen(scene: Scene, hit: Hit) -> Any:
    """Return a windscreen between its pillars."""
    base, width = _base(scene.faces, hit.face), scene.faces.size[hit.face, 0]
    height = scene.faces.size[hit.face, 1]
    level = hit.v / height
    half = 0.5 * width - 0.05 - 0.21 * (level if hit.ny < 0 else 1 - level) * (width / 1.76)
    glass = band(abs(hit.u), -1.0, half, hit.du) * band(level, 0.06, 0.94, hit.dv / height)
    keep = 1.0 - glass
    return (
        base[0] * keep + 0.015 * glass,
        base[1] * keep + 0.018 * glass,
        base[2] * keep + 0.020 * glass,
        0.2 * keep + glass,
    )


@inlined
def _car_end(scene: Scene, hit: Hit) -> Any:
    """Return paint, with lamps, grille and number plate at the front and the rear."""
    faces, face = scene.faces, hit.face
    red, green, blue = _base(faces, face)
    end, width, height = faces.params[face, 0], faces.size[face, 0], faces.size[face, 1]
    if end < 0.5:
        return red, green, blue, 0.25
    middle, level, dv = abs(hit.u), hit.v / height, hit.dv / height
    if end > 1.5:
        level = 1.0 - level
    lamp = band(middle, 0.5 * width - 0.40, 0.5 * width - 0.04, hit.du) * band(level, 0.42, 0.9, dv)
    plate = band(middle, -1.0, 0.26, hit.du) * band(level, 0.08, 0.46, dv)
    grille = band(middle, -1.0, 0.5 * width - 0.44, hit.du) * band(level, 0.52, 0.88, dv)
    grille *= 0.85 if end < 1.5 else 0.0
    keep = (1.0 - grille) * (1.0 - plate) * (1.0 - lamp)
    if end < 1.5:
        return (
            red * keep + 0.5 * plate + 0.42 * lamp,
            green * keep + 0.5 * plate + 0.42 * lamp,
            blue * keep + 0.47 * plate + 0.40 * lamp,
            0.25 + 0.4 * lamp,
        )
    inner = 0.5 if middle < 0.5 * width - 0.26 else 1.0
    return (
        red * keep + 0.5 * plate + 0.30 * inner * lamp,
        green * keep + 0.48 * plate + 0.012 * lamp,
        blue * keep + 0.30 * plate + 0.010 * lamp,
        0.25,
    )


@inlined
def _car_side(scene: Scene, hit: Hit) -> Any:
    """Return doors, windows and wheel arches; u runs from the front to the rear."""
    faces, face = scene.faces, hit.face
    length, height = faces.size[face, 0], faces.size[face, 1]
    belt = faces.accent[face, 0]
    base = _base(faces, face)
    u, v, du = hit.u / length, hit.v, hit.du / length
    rise = min(max((v - belt) / (height - belt), 0.0), 1.0)
    front = faces.params[face, 0] + (faces.params[face, 1] - faces.params[face, 0]) * rise
    rear = faces.params[face, 3] + (faces.params[face, 2] - faces.params[face, 3]) * rise
    glass = band(v, belt + 0.03, height - 0.10, hit.dv) * band(u, front + 0.025, rear - 0.03, du)
    pillar = 0.53 if rear > 0.6 else 0.50
    glass *= (1.0 - band(u, pillar, pillar + 0.022, du)) * (1.0 - band(u, 0.735, 0.75, du))
    seam = band(u, 0.315, 0.319, du) + band(u, pillar + 0.01, pillar + 0.014, du)
    seam += band(u, 0.742, 0.746, du)
    seam *= band(v, 0.32, belt + 0.02, hit.dv)
    handle = band(v, belt - 0.12, belt - 0.09, hit.dv)
    handle *= band(u, 0.475, 0.51, du) + band(u, 0.69, 0.725, du)
    crease = 0.25 * band(v, belt - 0.22, belt - 0.2, hit.dv)
    wheel = 0.185 if height < 1.8 else 0.16
    radius = 0.27 * min(height, 1.5)
    level = v - 0.22 * min(height, 1.5)
    arch = _disc((u - wheel) * length, level, radius, hit)
    arch = max(arch, _disc((u - 1.0 + wheel) * length, level, radius, hit))
    sill = band(v, 0.0, 0.30, hit.dv)
    dark = min(max(0.85 * sill, arch, 0.75 * max(seam, handle), crease), 1.0)
    keep = (1 - dark) * (1 - glass)
    hold = 0.012 * (1 - keep)
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
