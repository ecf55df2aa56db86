"""Houses: walls with windows and doors, roofs, chimneys, garden walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.mesh import (
    ROOF,
    WALL,
    Color,
    Face,
    MeshBuilder,
    Placement,
    as_color,
    box,
)

Array = NDArray[np.float64]

BRICK, PLASTER, STONE, BOARDS = range(4)
BURIED_M = 2.0  # walls go on below the ground, which may slope
STOREY_M = 2.9

# linear RGB: brick, plaster, stone, boards
WALL_COLORS: tuple[tuple[Color, ...], ...] = (
    ((0.30, 0.085, 0.05), (0.22, 0.075, 0.05), (0.36, 0.15, 0.08), (0.42, 0.27, 0.13)),
    (
        *((0.55, 0.40, 0.20), (0.60, 0.52, 0.38), (0.40, 0.16, 0.09), (0.20, 0.25, 0.28)),
        *((0.52, 0.27, 0.12), (0.30, 0.33, 0.20), (0.62, 0.58, 0.50)),
    ),
    ((0.33, 0.28, 0.21), (0.24, 0.23, 0.22), (0.40, 0.33, 0.22)),
    ((0.16, 0.09, 0.05), (0.10, 0.16, 0.19), (0.30, 0.07, 0.05), (0.13, 0.18, 0.11)),
)
ROOF_COLORS: tuple[Color, ...] = (
    *((0.32, 0.09, 0.045), (0.21, 0.07, 0.045), (0.075, 0.075, 0.08), (0.14, 0.10, 0.08)),
)
DOOR_COLORS: tuple[Color, ...] = (
    *((0.05, 0.12, 0.06), (0.18, 0.03, 0.02), (0.04, 0.07, 0.16), (0.16, 0.08, 0.03)),
)


@dataclass(frozen=True)
class HouseSize:
    """Metres along the street and away from it, number of storeys, and the roof's kind."""

    width: float
    depth: float
    storeys: int
    roof: str  # "along", "across", "hip" or "flat"
    has_bay: bool = False  # a bay window, 1.1 m deep, in front of the front

    @property
    def height(self) -> float:
        """Return the height of the walls in metres."""
        return self.storeys * STOREY_M + 0.4


def draw_size(rng: np.random.Generator) -> HouseSize:
    """Draw a house of a residential street; now and then a block of flats."""
    if rng.random() < 0.14:
        roof = "flat" if rng.random() < 0.7 else "hip"
        width, depth = rng.uniform(13, 20), rng.uniform(9, 11)
        return HouseSize(float(width), float(depth), int(rng.integers(3, 6)), roof)
    roof = str(rng.choice(["along", "across", "hip", "along", "flat"], p=[0.3, 0.3, 0.2, 0.1, 0.1]))
    width, depth = rng.uniform(6.5, 12), rng.uniform(7, 9.5)
    return HouseSize(float(width), float(depth), int(rng.integers(1, 4)), roof)


def add_house(
    builder: MeshBuilder, place: Placement, size: HouseSize, rng: np.random.Generator
) -> None:
    """Add a house whose front's middle stands at ``place`` and faces its front direction."""
    style = int(rng.choice([BRICK, PLASTER, STONE, BOARDS], p=[0.38, 0.38, 0.12, 0.12]))
    color = _varied(WALL_COLORS[style], rng)
    accent = _varied(DOOR_COLORS, rng)
    spacing = float(rng.uniform(2.1, 3.2))
    look = (float(style), spacing, float(rng.integers(0, 4)), float(size.storeys))
    low = np.array([-size.width / 2, 0.0, -size.depth])
    high = np.array([size.width / 2, size.height, 0.0])
    walls = [
        _wall(place, corner, along, size.height, (color, accent, look, int(rng.integers(1 << 30))))
        for corner, along, _ in box(low, high)[:4]
    ]
    for wall in walls:
        _add_rectangle(builder, wall, -BURIED_M, size.height)
    roof_color = _varied(ROOF_COLORS, rng)
    _add_roof(builder, place, size, walls, roof_color)
    _add_extras(builder, place, size, (color, roof_color), rng)


def add_garden_wall(
    builder: MeshBuilder, place: Placement, length: float, rng: np.random.Generator
) -> None:
    """Add a low wall along the street, its middle at ``place``."""
    style = int(rng.choice([BRICK, STONE, BOARDS]))
    height = float(rng.uniform(0.8, 1.7))
    low = np.array([-length / 2, -0.6, -0.25])
    high = np.array([length / 2, height, 0.0])
    _add_block(builder, place, (low, high), _varied(WALL_COLORS[style], rng), style)


def _varied(colors: tuple[Color, ...], rng: np.random.Generator) -> Color:
    base = np.array(colors[int(rng.integers(len(colors)))])
    return as_color(base * rng.uniform(0.75, 1.25) * rng.uniform(0.9, 1.1, 3))


def _wall(
    place: Placement,
    corner: Array,
    along: Array,
    height: float,
    look: tuple[Color, Color, tuple[float, float, float, float], int],
) -> Face:
    axes = np.stack(place.axes())
    length = float(np.linalg.norm(along))
    color, accent, params, seed = look
    return Face(
        WALL,
        place.world(corner),
        (along / length) @ axes,
        axes[1],
        (length, height),
        color,
        accent,
        params,
        seed,
    )


def _add_rectangle(builder: MeshBuilder, face: Face, low: float, high: float) -> None:
    ends = np.stack([face.origin, face.origin + face.size[0] * face.u_axis])
    corners = [ends[0] + low * face.v_axis, ends[1] + low * face.v_axis]
    corners += [ends[1] + high * face.v_axis, ends[0] + high * face.v_axis]
    builder.add_polygon(face, np.stack(corners))


def _add_roof(
    builder: MeshBuilder, place: Placement, size: HouseSize, walls: list[Face], color: Color
) -> None:
    w, d, h = size.width / 2, size.depth, size.height
    if size.roof == "flat":
        low, high = np.array([-w - 0.2, h - 0.25, -d - 0.2]), np.array([w + 0.2, h + 0.35, 0.2])
        _add_block(builder, place, (low, high), (0.30, 0.29, 0.27), PLASTER)
        return
    along = size.roof != "across"
    half = d / 2 if along else w
    rise, over = 0.75 * half, 0.45
    drop = over * rise / half
    x0, x1, z0, z1 = -w - over, w + over, -d - over, over
    y, top = h - drop, h + rise
    inset = half if size.roof == "hip" else 0.0
    if along:
        inset = min(inset, w)
        ridge = [[x0 + inset, top, -d / 2], [x1 - inset, top, -d / 2]]
    else:
        ridge = [[0.0, top, z0], [0.0, top, z1]]
    eaves = [[x0, y, z1], [x1, y, z1], [x1, y, z0], [x0, y, z0]]
    for polygon in _slopes(np.array(eaves), np.array(ridge), along):
        _add_slope(builder, place, polygon, color)
    if size.roof != "hip":
        for wall in (walls[1], walls[3]) if along else (walls[0], walls[2]):
            ends = [wall.origin + h * wall.v_axis]
            ends.append(ends[0] + wall.size[0] * wall.u_axis)
            peak = (ends[0] + ends[1]) / 2 + rise * wall.v_axis
            builder.add_polygon(wall, np.stack([*ends, peak]))


def _slopes(eaves: Array, ridge: Array, along: bool) -> list[Array]:
    """Return the roof's sides; each begins with its eave, left to right."""
    a, b, c, d = eaves
    left, right = ridge
    if along:
        ends = [np.stack([b, c, right]), np.stack([d, a, left])]
        return [np.stack([a, b, right, left]), np.stack([c, d, left, right]), *ends]
    back, front = ridge
    return [np.stack([b, c, back, front]), np.stack([d, a, front, back])]


def _add_slope(builder: MeshBuilder, place: Placement, polygon: Array, color: Color) -> None:
    corners = place.world(polygon)
    u = corners[1] - corners[0]
    normal = np.cross(u, corners[2] - corners[0])
    if np.linalg.norm(normal) < 1e-9:
        return
    v = np.cross(normal, u)
    u, v = u / np.linalg.norm(u), v / np.linalg.norm(v)
    seed = int(abs(corners[0] @ np.array([91.0, 17.0, 53.0])))
    builder.add_polygon(Face(ROOF, corners[0], u, v, color=color, seed=seed), corners)


def _add_block(
    builder: MeshBuilder,
    place: Placement,
    corners: tuple[Array, Array],
    color: Color,
    style: int,
) -> None:
    """Add a box with plain walls: no windows, no doors."""
    low, high = corners
    for index, (corner, u, v) in enumerate(box(low, high)):
        quad = place.world(np.stack([corner, corner + u, corner + u + v, corner + v]))
        lengths = np.linalg.norm(u), np.linalg.norm(v)
        axes = (quad[1] - quad[0]) / lengths[0], (quad[3] - quad[0]) / lengths[1]
        params = (float(style), 3.0, 0.0, 0.0)
        size = (float(lengths[0]), float(lengths[1]))
        face = Face(WALL, quad[0], *axes, size, color, color, params, index)
        builder.add_polygon(face, quad)


def _add_extras(
    builder: MeshBuilder,
    place: Placement,
    size: HouseSize,
    colors: tuple[Color, Color],
    rng: np.random.Generator,
) -> None:
    """Add a chimney, and to some houses a bay window with a roof of its own."""
    x = float(rng.uniform(-0.3, 0.3)) * size.width
    z = -size.depth / 2 + float(rng.uniform(-0.5, 0.5))
    top = size.height + 0.42 * min(size.depth, size.width) + float(rng.uniform(0.4, 1.0))
    if size.roof != "flat":
        low, high = np.array([x - 0.35, size.height - 1, z - 0.35]), np.array([x + 0.35, top, z])
        _add_block(builder, place, (low, high), WALL_COLORS[BRICK][int(rng.integers(3))], BRICK)
    if size.has_bay:
        x = float(rng.choice([-0.28, 0.28])) * size.width
        bay = HouseSize(2.6, 1.2, 1, "flat")
        forward = Placement(place.world(np.array([x, 0.0, 1.1])), place.yaw)
        walls = box(np.array([-1.3, 0.0, -1.1]), np.array([1.3, bay.height, 0.0]))
        look = (colors[0], colors[0], (1.0, 2.6, 3.0, 1.0), int(rng.integers(1 << 30)))
        for corner, along, _ in walls[:4]:
            wall = _wall(forward, corner, along, bay.height, look)
            _add_rectangle(builder, wall, -BURIED_M, bay.height)
        cap = np.array([-1.5, bay.height, -1.1]), np.array([1.5, bay.height + 0.25, 0.2])
        _add_block(builder, forward, cap, colors[1], BOARDS)
