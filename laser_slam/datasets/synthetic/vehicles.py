"""Parked cars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.mesh import (
    CAR_SIDE,
    GLASS,
    PAINT,
    PLAIN,
    TYRE,
    Color,
    Face,
    MeshBuilder,
    Placement,
    as_color,
)

Array = NDArray[np.float64]

PAINT_COLORS: tuple[Color, ...] = (
    *((0.45, 0.45, 0.46), (0.015, 0.015, 0.018), (0.62, 0.62, 0.60), (0.10, 0.11, 0.12)),
    *((0.33, 0.02, 0.02), (0.02, 0.06, 0.24), (0.04, 0.13, 0.07), (0.30, 0.25, 0.15)),
    *((0.50, 0.28, 0.02), (0.02, 0.16, 0.22)),
)
# Outline of the side as shares of length and height: front bumper up to the bonnet, foot and top
# of the windscreen, top and foot of the rear window, boot down to the rear bumper.
Outline = tuple[tuple[float, float], ...]
SALOON: Outline = (
    *((0.01, 0.16), (0.0, 0.34), (0.015, 0.50), (0.24, 0.63), (0.43, 0.985)),
    *((0.68, 0.985), (0.85, 0.63), (0.985, 0.60), (1.0, 0.34), (0.99, 0.18)),
)
ESTATE: Outline = (
    *((0.01, 0.15), (0.0, 0.33), (0.015, 0.48), (0.23, 0.61), (0.40, 0.985)),
    *((0.90, 0.985), (0.975, 0.61), (0.985, 0.57), (1.0, 0.33), (0.99, 0.17)),
)
VAN: Outline = (
    *((0.01, 0.12), (0.0, 0.26), (0.015, 0.36), (0.13, 0.50), (0.25, 0.985)),
    *((0.97, 0.985), (0.985, 0.50), (0.99, 0.45), (1.0, 0.26), (0.99, 0.13)),
)
FOOT_FRONT, TOP_FRONT, TOP_REAR, FOOT_REAR = 3, 4, 5, 6
STRIPS = (PLAIN, PAINT, PAINT, GLASS, PAINT, GLASS, PAINT, PAINT, PLAIN)
FRONT_LAMPS, REAR_LAMPS = 1, 7
WIDTH_M = 1.76
BUMPER_COLOR = (0.03, 0.03, 0.032)


def add_car(builder: MeshBuilder, place: Placement, rng: np.random.Generator) -> float:
    """Add a car whose middle stands at ``place``, pointing to its front; return its length."""
    kind = int(rng.choice(3, p=[0.45, 0.43, 0.12]))
    outline = (SALOON, ESTATE, VAN)[kind]
    length = (4.4, 4.2, 5.0)[kind] * float(rng.uniform(0.93, 1.05))
    height = (1.43, 1.52, 2.1)[kind] * float(rng.uniform(0.96, 1.05))
    color = as_color(
        np.array(PAINT_COLORS[int(rng.integers(len(PAINT_COLORS)))]) * rng.uniform(0.8, 1.2)
    )
    profile = np.array(outline) * (length, height)
    inset = np.zeros(len(profile))
    inset[[TOP_FRONT, TOP_REAR]] = 0.06 if kind == 2 else 0.2
    z = length / 2 - profile[:, 0]
    half = WIDTH_M / 2 - inset
    left = np.stack([-half, profile[:, 1], z], axis=1)
    right = np.stack([half, profile[:, 1], z], axis=1)
    seed = int(rng.integers(1 << 30))
    _add_strips(builder, place, (left, right), color, seed)
    _add_sides(builder, place, (left, right), (color, length, height), seed)
    wheel = (0.185 if kind < 2 else 0.16) * length
    for x in (-half.max(), half.max()):
        for along in (length / 2 - wheel, -length / 2 + wheel):
            _add_wheel(builder, place, np.array([x, 0.0, along]), 0.22 * min(height, 1.5))
    return length


def _add_strips(
    builder: MeshBuilder,
    place: Placement,
    rails: tuple[Array, Array],
    color: Color,
    seed: int,
) -> None:
    left, right = rails
    for k, material in enumerate(STRIPS):
        quad = place.world(np.stack([left[k], right[k], right[k + 1], left[k + 1]]))
        u, v = quad[1] - quad[0], quad[3] - quad[0]
        width = float(np.linalg.norm(u))
        v = v - u * (u @ v) / float(u @ u)
        height = float(np.linalg.norm(v))
        end = 1.0 if k == FRONT_LAMPS else 2.0 if k == REAR_LAMPS else 0.0
        look = color if material != PLAIN else BUMPER_COLOR
        middle = (quad[0] + quad[1]) / 2
        params = (end, 0.0, 0.0, 0.0)
        size = (width, height)
        face = Face(material, middle, u / width, v / height, size, look, color, params, seed)
        builder.add_polygon(face, quad)


def _add_sides(
    builder: MeshBuilder,
    place: Placement,
    rails: tuple[Array, Array],
    look: tuple[Color, float, float],
    seed: int,
) -> None:
    """Add both sides: the body below the windows, and the windows, which lean inwards."""
    color, length, height = look
    axes = np.stack(place.axes())
    feet = [FOOT_FRONT, TOP_FRONT, TOP_REAR, FOOT_REAR]
    for rail in rails:
        origin = place.world(np.array([rail[0, 0], 0.0, length / 2]))
        shares = [float(0.5 - rail[k, 2] / length) for k in feet]
        params = (shares[0], shares[1], shares[2], shares[3])
        belt = (float(rail[FOOT_FRONT, 1]), 0.0, 0.0)
        face = Face(
            CAR_SIDE, origin, -axes[2], axes[1], (length, height), color, belt, params, seed
        )
        builder.add_polygon(face, place.world(rail[[0, 1, 2, FOOT_FRONT, FOOT_REAR, 7, 8, 9]]))
        builder.add_polygon(face, place.world(rail[feet]))


def _add_wheel(builder: MeshBuilder, place: Placement, foot: Array, radius: float) -> None:
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    side = np.sign(foot[0])
    ring = np.stack([np.zeros(16), radius * (1 + np.sin(around)), radius * np.cos(around)], axis=1)
    outer = foot + ring + np.array([0.02 * side, 0.0, 0.0])
    inner = foot + ring - np.array([0.18 * side, 0.0, 0.0])
    axes = np.stack(place.axes())
    hub = place.world(foot + np.array([0.02 * side, radius, 0.0]))
    face = Face(TYRE, hub, axes[2], axes[1], (radius, radius))
    k = np.arange(16)
    after = (k + 1) % 16
    sides = [np.stack([k, after, after + 16], 1), np.stack([k, after + 16, k + 16], 1)]
    builder.add(face, place.world(np.concatenate([outer, inner])), np.concatenate(sides))
    builder.add_polygon(face, place.world(outer))
