"""Street furniture: lamp posts, signs, bollards, bins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.mesh import (
    PLAIN,
    SIGN,
    Color,
    Face,
    MeshBuilder,
    Placement,
    box,
)

Array = NDArray[np.float64]


def add_lamp(builder: MeshBuilder, place: Placement, rng: np.random.Generator) -> None:
    """Add a lamp post; its arm reaches to the front."""
    height = float(rng.uniform(5.5, 7.5))
    tone = float(rng.uniform(0.05, 0.22))
    color = (tone, tone * 1.02, tone * 1.03)
    _add_post(builder, place, np.zeros(3), (0.085, height), color)
    _add_box(builder, place, ((-0.04, height - 0.1, -0.05), (0.04, height, 1.5)), color)
    lamp = ((-0.13, height - 0.2, 1.0), (0.13, height - 0.02, 1.7))
    _add_box(builder, place, lamp, (0.5, 0.5, 0.47))


def add_sign(builder: MeshBuilder, place: Placement, rng: np.random.Generator) -> None:
    """Add a traffic sign that faces its front."""
    height = float(rng.uniform(2.2, 2.8))
    kind = float(rng.integers(0, 4))
    _add_post(builder, place, np.zeros(3), (0.035, height + 0.2), (0.30, 0.31, 0.32))
    half = 0.33 if kind < 3 else 0.45
    right, up, _ = place.axes()
    low = place.world(np.array([-half, height - half, 0.05]))
    count = 16 if kind == 0 else 4  # kind 0 is round
    angle = (np.arange(count) + 0.5) * 2 * np.pi / count
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    local = ring * (half if kind == 0 else half * 1.414) + np.array([0.0, height, 0.05])
    face = Face(
        SIGN,
        low,
        right,
        up,
        (2 * half, 2 * half),
        params=(kind, 0.0, 0.0, 0.0),
        seed=int(rng.integers(1 << 30)),
    )
    builder.add_polygon(face, place.world(local))


def add_bollard(builder: MeshBuilder, place: Placement, rng: np.random.Generator) -> None:
    """Add a bollard or a litter bin."""
    if rng.random() < 0.6:
        tone = float(rng.uniform(0.04, 0.4))
        _add_post(builder, place, np.zeros(3), (0.09, 0.95), (tone, tone, tone))
        _add_post(builder, place, np.array([0.0, 0.95, 0.0]), (0.12, 0.1), (0.3, 0.03, 0.02))
    else:
        color = (0.03, 0.09, 0.04) if rng.random() < 0.5 else (0.05, 0.06, 0.10)
        _add_box(builder, place, ((-0.28, 0.0, -0.28), (0.28, 1.05, 0.28)), color)
        _add_box(builder, place, ((-0.32, 1.05, -0.32), (0.32, 1.15, 0.34)), (0.1, 0.1, 0.1))


def _add_post(
    builder: MeshBuilder,
    place: Placement,
    foot: Array,
    size: tuple[float, float],
    color: Color,
) -> None:
    radius, height = size
    around = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = np.stack([radius * np.cos(around), np.zeros(8), radius * np.sin(around)], axis=1)
    below = 0.5 if foot[1] == 0 else 0.0
    local = np.concatenate([ring - [0, below, 0], ring * 0.8 + [0, height, 0]]) + foot
    k = np.arange(8)
    after = (k + 1) % 8
    sides = [np.stack([k, after, after + 8], 1), np.stack([k, after + 8, k + 8], 1)]
    lid = np.array([[8, 8 + j, 9 + j] for j in range(1, 7)])
    face = Face(PLAIN, place.origin, color=color)
    builder.add(face, place.world(local), np.concatenate([*sides, lid]))


def _add_box(
    builder: MeshBuilder,
    place: Placement,
    corners: tuple[tuple[float, float, float], tuple[float, float, float]],
    color: Color,
) -> None:
    for corner, u, v in box(np.array(corners[0]), np.array(corners[1])):
        quad = place.world(np.stack([corner, corner + u, corner + u + v, corner + v]))
        builder.add_polygon(Face(PLAIN, quad[0], color=color), quad)
