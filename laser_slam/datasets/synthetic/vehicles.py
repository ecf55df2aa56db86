"""Parked cars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.mesh import (
    CAR_SIDE,
    GLASS,
    PAINT,
    TYRE,
    Color,
    Face,
    MeshBuilder,
    Placement,
)

Array = NDArray[np.float64]

PAINT_COLORS: tuple[Color, ...] = (
    *((0.45, 0.45, 0.46), (0.015, 0.015, 0.018), (0.62, 0.62, 0.60), (0.10, 0.11, 0.12)),
    *((0.33, 0.02, 0.02), (0.02, 0.06, 0.24), (0.04, 0.13, 0.07), (0.30, 0.25, 0.15)),
    *((0.50, 0.28, 0.02), (0.02, 0.16, 0.22)),
)
# Outline of the side from the front bumper over the roof to the rear, as shares of length and
# height, with the material of the strip that follows each point.
SALOON = ((0.0, 0.24), (0.005, 0.47), (0.05, 0.55), (0.26, 0.63), (0.42, 0.97), (0.66, 1.0))
SALOON += ((0.82, 0.68), (0.985, 0.63), (1.0, 0.42), (0.99, 0.22))
ESTATE = ((0.0, 0.22), (0.005, 0.45), (0.05, 0.54), (0.24, 0.61), (0.38, 0.96), (0.60, 1.0))
ESTATE += ((0.90, 0.95), (0.985, 0.60), (1.0, 0.40), (0.99, 0.20))
VAN = ((0.0, 0.18), (0.005, 0.36), (0.03, 0.44), (0.16, 0.53), (0.28, 0.95), (0.36, 1.0))
VAN += ((0.97, 1.0), (0.99, 0.55), (1.0, 0.30), (0.99, 0.16))
STRIPS = (PAINT, PAINT, PAINT, GLASS, PAINT, PAINT, GLASS, PAINT, PAINT)
WIDTH_M = 1.76


def add_car(builder: MeshBuilder, place: Placement, rng: np.random.Generator) -> float:
    """Add a car whose middle stands at ``place``, pointing to its front; return its length."""
    kind = int(rng.choice(3, p=[0.45, 0.43, 0.12]))
    outline = (SALOON, ESTATE, VAN)[kind]
    length = (4.4, 4.2, 5.0)[kind] * float(rng.uniform(0.93, 1.05))
    height = (1.43, 1.52, 2.1)[kind] * float(rng.uniform(0.96, 1.05))
    base = np.array(PAINT_COLORS[int(rng.integers(len(PAINT_COLORS)))])
    color = tuple(float(c) for c in base * rng.uniform(0.8, 1.2))
    profile = np.array(outline) * (length, height)
    shoulder = 0.64 * height
    inset = np.clip((profile[:, 1] - shoulder) / (height - shoulder), 0, 1) * 0.24
    inset += np.where(np.isin(np.arange(len(profile)), (0, 1, 8, 9)), 0.10, 0.0)
    z = length / 2 - profile[:, 0]
    half = WIDTH_M / 2 - inset
    left = np.stack([-half, profile[:, 1], z], axis=1)
    right = np.stack([half, profile[:, 1], z], axis=1)
    seed = int(rng.integers(1 << 30))
    _add_strips(builder, place, (left, right), color, seed)
    _add_sides(builder, place, (left, right), (color, length, height, shoulder), seed)
    wheel = (0.185 if kind < 2 else 0.16) * length
    for x in (-half.max(), half.max()):
        for along in (length / 2 - wheel, -length / 2 + wheel):
            _add_wheel(builder, place, np.array([x, 0.0, along]), 0.22 * height)
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
        size = (float(np.linalg.norm(u)), float(np.linalg.norm(v)))
        v = v - u * (u @ v) / max(float(u @ u), 1e-9)
        axes = u / size[0], v / max(float(np.linalg.norm(v)), 1e-9)
        # params[0]: which end of the car this strip shows lamps for, 1 front, 2 rear
        end = 1.0 if k == 0 else 2.0 if k in (7, 8) else 0.0
        params = (end, 0.0, 0.0, 0.0)
        builder.add_polygon(Face(material, quad[0], *axes, size, color, color, params, seed), quad)


def _add_sides(
    builder: MeshBuilder,
    place: Placement,
    rails: tuple[Array, Array],
    look: tuple[Color, float, float, float],
    seed: int,
) -> None:
    """Add both sides: below the shoulder one polygon, above it the windows' slanted part."""
    color, length, height, shoulder = look
    axes = np.stack(place.axes())
    for rail in rails:
        origin = place.world(np.array([rail[3, 0], 0.0, length / 2]))
        params = (shoulder, height, 0.0, 0.0)
        face = Face(
            CAR_SIDE, origin, -axes[2], axes[1], (length, height), color, color, params, seed
        )
        lower, upper = [0, 1, 2, 3, 6, 7, 8, 9], [3, 4, 5, 6]
        builder.add_polygon(face, place.world(rail[lower]))
        builder.add_polygon(face, place.world(rail[upper]))


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
    tread = np.concatenate(
        [np.stack([k, after, after + 16], 1), np.stack([k, after + 16, k + 16], 1)]
    )
    builder.add(face, place.world(np.concatenate([outer, inner])), tread)
    builder.add_polygon(face, place.world(outer))
