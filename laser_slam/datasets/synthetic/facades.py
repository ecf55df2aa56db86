"""Looks of buildings: walls with windows and doors, roofs. Linear RGB."""

from __future__ import annotations

from typing import Any

import numpy as np

from laser_slam.datasets.synthetic.hit import Hit, face_noise
from laser_slam.datasets.synthetic.houses import BOARDS, BRICK, STONE, STOREY_M
from laser_slam.datasets.synthetic.kernels import inlined, kernel
from laser_slam.datasets.synthetic.textures import CLOUDS, GRAIN, band, hash01, pulse
from laser_slam.datasets.synthetic.world import Scene

PLINTH_M = 0.5


@inlined
def wall_color(scene: Scene, hit: Hit) -> Any:
    """Return (red, green, blue, gloss): the albedo of a wall, and how much glass it shows."""
    faces, face = scene.faces, hit.face
    seed = faces.seed[face]
    shift = hash01(seed, 3, 1) * 7.0
    tone = _masonry(hit, int(faces.params[face, 0]), seed)
    tone += 0.10 * face_noise(scene.textures, GRAIN, hit, 1.9, shift)
    tone += 0.10 * face_noise(scene.textures, CLOUDS, hit, 6.3, shift)
    tone *= 0.80 + 0.2 * min(max(hit.v / 1.2, 0.0), 1.0)  # splashes above the ground
    tone = max(tone, 0.1)
    red, green = faces.color[face, 0] * tone, faces.color[face, 1] * tone
    blue = faces.color[face, 2] * tone
    if hit.v < PLINTH_M and faces.params[face, 3] > 0:
        grey = 0.5 * (red + green + blue) / 3 + 0.05 * tone
        red, green, blue = grey, grey, grey
    column, row, fu, fv = _bay(hit, faces.params[face, 1], faces.size[face, 0])
    if row < 0 or row >= int(faces.params[face, 3]):
        return red, green, blue, 0.0
    kind = int(faces.params[face, 2])
    cell = (column, row, fu, fv, seed, kind)
    if row == 0 and column == int(hash01(seed, 9, 9) * faces.size[face, 0] / 3.0):
        return _door(hit, cell, (red, green, blue), _accent(scene, face))
    return _window(scene, hit, cell, (red, green, blue))


@inlined
def _accent(scene: Scene, face: int) -> Any:
    accent = scene.faces.accent
    return accent[face, 0], accent[face, 1], accent[face, 2]


@inlined
def _bay(hit: Hit, spacing: float, width: float) -> Any:
    """Return column, row and the metres from the column's middle and the storey's floor."""
    columns = max(int(width / spacing), 1)
    pitch = width / columns
    column = int(np.floor(hit.u / pitch))
    row = int(np.floor((hit.v - 0.2) / STOREY_M))
    if column < 0 or column >= columns or pitch < 1.9:
        return column, -1, 0.0, 0.0
    return column, row, hit.u - (column + 0.5) * pitch, hit.v - 0.2 - row * STOREY_M


@inlined
def _masonry(hit: Hit, style: int, seed: int) -> Any:
    """Return the tone of the courses, about 1."""
    if style == BRICK:
        return _courses(hit, 0.26, 0.085, 0.35)
    if style == STONE:
        return _courses(hit, 0.62 + 0.2 * hash01(seed, 1, 1), 0.31, 0.5)
    if style == BOARDS:
        row = int(np.floor(hit.v / 0.19))
        own = (hash01(row, seed, 4) - 0.5) * 0.3 * max(0.0, 1.0 - hit.dv / 0.19)
        return 1.0 + own - 0.55 * pulse(hit.v, 0.19, 0.025, hit.dv)
    return 1.0 - 0.18 * pulse(hit.v - 0.1, STOREY_M, 0.09, hit.dv)  # plaster with string courses


@kernel
def _courses(hit: Hit, length: float, height: float, contrast: float) -> Any:
    row = int(np.floor(hit.v / height))
    u = hit.u + 0.5 * length * (row & 1)
    column = int(np.floor(u / length))
    joint = max(pulse(hit.v, height, 0.012, hit.dv), pulse(u, length, 0.012, hit.du))
    own = (hash01(row, column, 5) - 0.5) * contrast
    own *= max(0.0, 1.0 - hit.dv / height) * max(0.0, 1.0 - hit.du / length)
    # groups of bricks differ too: what is left to see from afar
    group = (hash01(row // 6, column // 4, 6) - 0.5) * 0.16 * max(0.0, 1.0 - hit.dv / 0.5)
    return (1.0 + own + group) * (1 - 0.3 * joint) + 0.25 * joint


@inlined
def _rectangle(fu: float, fv: float, edges: Any, hit: Hit) -> Any:
    left, right, low, high = edges
    return band(fu, left, right, hit.du) * band(fv, low, high, hit.dv)


@inlined
def _mix(color: Any, share: float, other: Any) -> Any:
    keep = 1.0 - share
    return (
        color[0] * keep + other[0] * share,
        color[1] * keep + other[1] * share,
        color[2] * keep + other[2] * share,
    )


@inlined
def _door(hit: Hit, cell: Any, wall: Any, accent: Any) -> Any:
    _, _, fu, fv, seed, _ = cell
    frame = _rectangle(fu, fv, (-0.68, 0.68, -0.2, 2.35), hit)
    leaf = _rectangle(fu, fv, (-0.52, 0.52, -0.2, 1.95), hit)
    light = _rectangle(fu, fv, (-0.52, 0.52, 2.0, 2.25), hit)
    panel = _rectangle(abs(fu), fv, (0.1, 0.4, 0.2, 0.85), hit)
    panel += _rectangle(abs(fu), fv, (0.1, 0.4, 1.0, 1.7), hit)
    tone = 1.0 - 0.35 * panel
    color = _mix(wall, frame, (0.50, 0.49, 0.46))
    color = _mix(color, leaf, (accent[0] * tone, accent[1] * tone, accent[2] * tone))
    color = _mix(color, light, (0.03, 0.035, 0.04))
    step = _rectangle(fu, fv, (-0.9, 0.9, -0.4, -0.2 + 0.1 * hash01(seed, 8, 8)), hit)
    color = _mix(color, step, (0.28, 0.27, 0.25))
    return color[0], color[1], color[2], 0.5 * light


@inlined
def _window(scene: Scene, hit: Hit, cell: Any, wall: Any) -> Any:
    column, row, fu, fv, seed, kind = cell
    if hash01(seed, column, 11) < 0.10:
        return wall[0], wall[1], wall[2], 0.0
    half = 0.42 + 0.22 * hash01(seed, 2, 12) + (0.25 if kind == 3 else 0.0)
    low, high = 0.85, 2.05 + 0.3 * hash01(seed, 2, 13)
    color = wall
    if kind == 1:  # shutters
        slats = 1.0 - 0.4 * pulse(fv, 0.09, 0.035, hit.dv)
        accent = _accent(scene, hit.face)
        shutter = _rectangle(abs(fu), fv, (half + 0.08, half + 0.5, low, high), hit)
        color = _mix(
            color, shutter, (accent[0] * slats * 1.6, accent[1] * slats * 1.6, accent[2] * slats)
        )
    surround = 0.16 if kind == 2 else 0.08
    edges = (-half - surround, half + surround, low - surround, high + surround)
    color = _mix(color, _rectangle(fu, fv, edges, hit), (0.42, 0.40, 0.36))
    sill = _rectangle(fu, fv, (-half - 0.14, half + 0.14, low - 0.16, low - 0.06), hit)
    color = _mix(color, sill, (0.48, 0.46, 0.43))
    below = _rectangle(fu, fv, (-half - 0.14, half + 0.14, low - 0.27, low - 0.16), hit)
    color = _mix(color, 0.45 * below, (0.0, 0.0, 0.0))
    frame_tone = 0.06 if hash01(seed, 5, 14) < 0.3 else 0.62
    frame = _rectangle(fu, fv, (-half, half, low, high), hit)
    color = _mix(color, frame, (frame_tone, frame_tone, frame_tone * 0.97))
    glass = _panes(hit, fu, fv, (half, low, high), kind)
    inside = _behind_glass(hit, (column, row, seed), fv, (low, high))
    color = _mix(color, glass, inside)
    return color[0], color[1], color[2], glass


@inlined
def _panes(hit: Hit, fu: float, fv: float, opening: Any, kind: int) -> Any:
    half, low, high = opening
    bar = 0.06
    across = 0.0 if kind == 0 else bar / 2
    glass = band(abs(fu), across, half - bar, hit.du)
    rung = low + 0.62 * (high - low)
    upper = band(fv, rung + bar / 2, high - bar, hit.dv)
    lower = band(fv, low + bar, rung - bar / 2, hit.dv)
    return glass * (lower + upper)


@inlined
def _behind_glass(hit: Hit, cell: Any, fv: float, opening: Any) -> Any:
    """Return what is seen through a pane: a dark room, curtains, or a blind half down."""
    column, row, seed = cell
    low, high = opening
    shade = hash01(seed, column * 17 + row, 15)
    tone = 0.012 + 0.03 * hash01(seed, column * 17 + row, 16)
    height = (fv - low) / (high - low)
    if shade < 0.35:  # curtains with folds
        folds = pulse(hit.u, 0.16, 0.08, hit.du) - 0.5
        tone = 0.17 + 0.09 * folds + 0.08 * hash01(seed, column, 17)
        return tone, tone * 0.96, tone * 0.88
    if shade < 0.6 and height > 0.75 - 0.9 * (shade - 0.35) / 0.25:
        return 0.36, 0.34, 0.30
    return tone, tone * 1.1, tone * 1.25


@inlined
def roof_color(scene: Scene, hit: Hit) -> Any:
    """Return the albedo of a tiled roof."""
    faces, face = scene.faces, hit.face
    row = int(np.floor(hit.v / 0.32))
    column = int(np.floor((hit.u + 0.11 * (row & 1)) / 0.22))
    fade = max(0.0, 1.0 - hit.dv / 0.32) * max(0.0, 1.0 - hit.du / 0.22)
    tone = 1.0 + 0.5 * fade * (hash01(row, column, 21) - 0.5)
    tone += 0.2 * max(0.0, 1.0 - hit.dv / 1.3) * (hash01(row // 4, column // 6, 22) - 0.5)
    tone *= 1.0 - 0.5 * pulse(hit.v, 0.32, 0.05, hit.dv)
    shift = hash01(faces.seed[face], 1, 23)
    tone += 0.13 * face_noise(scene.textures, CLOUDS, hit, 5.3, shift)
    tone += 0.09 * face_noise(scene.textures, GRAIN, hit, 2.1, shift)
    tone = max(tone, 0.15)
    color = faces.color
    return color[face, 0] * tone, color[face, 1] * tone, color[face, 2] * tone
