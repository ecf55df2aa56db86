"""Trees, shrubs and hedges: bumpy crowns with loose clumps of leaves around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from laser_slam.datasets.synthetic.mesh import (
    BARK,
    LEAF,
    Color,
    Face,
    MeshBuilder,
    Placement,
    as_color,
)

Array = NDArray[np.float64]

LEAF_COLORS: tuple[Color, ...] = (
    *((0.055, 0.115, 0.018), (0.04, 0.085, 0.02), (0.09, 0.13, 0.02), (0.03, 0.07, 0.022)),
    *((0.12, 0.12, 0.02), (0.075, 0.105, 0.035)),
)


def _sphere(num: int) -> tuple[Array, NDArray[np.int64]]:
    """Return evenly spread points of the unit sphere and its triangles."""
    k = np.arange(num) + 0.5
    polar, around = np.arccos(1 - 2 * k / num), np.pi * (1 + 5**0.5) * k
    ring = np.sin(polar)
    points = np.stack([ring * np.cos(around), np.cos(polar), ring * np.sin(around)], axis=1)
    return points, ConvexHull(points).simplices.astype(np.int64)


FINE, COARSE = _sphere(90), _sphere(42)


def add_tree(
    builder: MeshBuilder,
    place: Placement,
    height: float,
    rng: np.random.Generator,
    detail: int = 2,
) -> None:
    """Add a tree at ``place``; every fifth is a conifer.

    Args:
        builder: takes the triangles.
        place: foot of the trunk.
        height: metres.
        rng: draws shape and colour.
        detail: 2 beside the street, 1 far from it: fewer triangles.
    """
    base = np.array(LEAF_COLORS[int(rng.integers(len(LEAF_COLORS)))])
    color = as_color(base * rng.uniform(0.8, 1.3) * rng.uniform(0.92, 1.08, 3))
    radius = 0.018 * height + 0.06
    _add_trunk(builder, place, radius, 0.6 * height, rng)
    if rng.random() < 0.2:
        _add_conifer(builder, place, height, color, rng)
    else:
        _add_crown(builder, place, height, (color, detail), rng)


def add_hedge(
    builder: MeshBuilder, place: Placement, size: tuple[float, float], rng: np.random.Generator
) -> None:
    """Add a trimmed hedge of (length, height) metres along the street, its middle at ``place``."""
    length, height = size
    steps = max(int(length / 0.35), 2)
    profile = np.array([[0.0, -0.5], [0.05, 0.5], [0.0, 0.93], [-0.12, 1.0]])
    profile = np.concatenate([profile, [[-0.6, 1.02], [-0.74, 0.93], [-0.7, 0.5], [-0.72, -0.5]]])
    x = np.linspace(-length / 2, length / 2, steps)
    points = np.zeros((steps, len(profile), 3))
    points[..., 0] = x[:, None]
    points[..., 1] = profile[:, 1] * height
    points[..., 2] = profile[:, 0]
    points += rng.normal(0, 0.045, points.shape)
    index = np.arange(steps * len(profile)).reshape(steps, len(profile))
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    caps = [[end[0], end[k], end[k + 1]] for end in (index[0], index[-1]) for k in range(1, 7)]
    base = np.array(LEAF_COLORS[int(rng.integers(4))]) * rng.uniform(0.8, 1.2)
    face = _leaf_face(place.world(np.array([0, 0.5 * height, -0.35])), as_color(base), 0.0, rng)
    triangles = np.concatenate([triangles, np.array(caps)])
    builder.add(face, place.world(points.reshape(-1, 3)), triangles)


def add_shrub(
    builder: MeshBuilder, place: Placement, radius: float, rng: np.random.Generator
) -> None:
    """Add a round shrub at ``place``."""
    base = np.array(LEAF_COLORS[int(rng.integers(len(LEAF_COLORS)))]) * rng.uniform(0.8, 1.3)
    center = place.world(np.array([0.0, 0.7 * radius, 0.0]))
    face = _leaf_face(center, as_color(base), radius, rng)
    vertices, triangles = _blob(center, np.full(3, radius), COARSE, rng)
    builder.add(face, vertices, triangles)
    builder.add(face, *_clumps(center, np.full(3, radius), 110, rng))


def _leaf_face(center: Array, color: Color, radius: float, rng: np.random.Generator) -> Face:
    """Describe foliage: ``params[0]`` > 0 rounds its shading off around the centre."""
    seed = int(rng.integers(1 << 30))
    return Face(LEAF, center, color=color, params=(radius, 0.0, 0.0, 0.0), seed=seed)


def _blob(
    center: Array,
    radii: Array,
    sphere: tuple[Array, NDArray[np.int64]],
    rng: np.random.Generator,
) -> tuple[Array, NDArray[np.int64]]:
    points, triangles = sphere
    bumps = rng.uniform(0.78, 1.12, len(points))[:, None]
    return center + points * bumps * radii, triangles


def _clumps(
    center: Array, radii: Array, num: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Return loose leaf-covered triangles around an ellipsoid: they fray its outline."""
    out = rng.standard_normal((num, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    middle = center + out * radii * rng.uniform(0.90, 1.13, (num, 1))
    size = rng.uniform(0.05, 0.13, (num, 1, 1)) * (0.7 + 0.25 * float(radii.mean()))
    corners = middle[:, None] + rng.standard_normal((num, 3, 3)) * size
    return corners.reshape(-1, 3), np.arange(3 * num).reshape(-1, 3)


def _add_crown(
    builder: MeshBuilder,
    place: Placement,
    height: float,
    look: tuple[Color, int],
    rng: np.random.Generator,
) -> None:
    color, detail = look
    spread = height * float(rng.uniform(0.24, 0.34))
    middle = np.array([0.0, 0.66 * height, 0.0])
    face = _leaf_face(place.world(middle), color, spread, rng)
    num = 7 if detail > 1 else 4
    around = np.arange(num) * 2.4 + rng.uniform(0, 6.3)
    level = (np.arange(num) + 0.5) / num * 2 - 1  # bottom to top
    ring = np.sqrt(1 - 0.8 * level**2) * spread * 0.62
    for k in range(num):
        offset = np.array([ring[k] * np.cos(around[k]), 0.0, ring[k] * np.sin(around[k])])
        offset[1] = level[k] * height * 0.20
        radii = spread * rng.uniform(0.5, 0.72) * np.array([1.0, rng.uniform(0.75, 0.95), 1.0])
        center = place.world(middle + offset)
        builder.add(face, *_blob(center, radii, FINE if detail > 1 else COARSE, rng))
        builder.add(face, *_clumps(center, radii, 190 if detail > 1 else 30, rng))


def _add_conifer(
    builder: MeshBuilder,
    place: Placement,
    height: float,
    color: Color,
    rng: np.random.Generator,
) -> None:
    dark = (color[0] * 0.5, color[1] * 0.62, color[2] * 0.9)
    face = _leaf_face(place.world(np.array([0, 0.5 * height, 0])), dark, 0.2 * height, rng)
    around = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    tiers = 7
    for tier in range(tiers):
        share = tier / tiers
        radius = (1 - share) * 0.21 * height + 0.15
        foot, top = (0.14 + 0.80 * share) * height, (0.14 + 0.80 * share + 0.24) * height
        ragged = radius * rng.uniform(0.7, 1.15, len(around))
        droop = foot + rng.uniform(-0.03, 0.03, len(around)) * height
        rim = np.stack([ragged * np.cos(around), droop, ragged * np.sin(around)], axis=1)
        local = np.concatenate([rim, [[0, min(top, height), 0], [0, foot + 0.05 * height, 0]]])
        k = np.arange(len(around))
        after = (k + 1) % len(around)
        sides = [np.stack([k, after, np.full_like(k, len(k) + j)], axis=1) for j in (0, 1)]
        builder.add(face, place.world(local), np.concatenate(sides))


def _add_trunk(
    builder: MeshBuilder,
    place: Placement,
    radius: float,
    height: float,
    rng: np.random.Generator,
) -> None:
    around = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rings = []
    lean = rng.normal(0, 0.03, 2) * height
    for y, r in ((-0.6, 1.5 * radius), (0.35, radius), (height, 0.6 * radius)):
        share = max(y, 0.0) / height
        ring = [r * np.cos(around) + lean[0] * share, np.full(8, y)]
        rings.append(np.stack([*ring, r * np.sin(around) + lean[1] * share], axis=1))
    tone = float(rng.uniform(0.7, 1.3))
    face = Face(BARK, place.origin, color=(0.10 * tone, 0.075 * tone, 0.055 * tone))
    k = np.arange(16)
    after = (k + 1) % 8 + 8 * (k // 8)
    triangles = np.concatenate(
        [np.stack([k, after, after + 8], 1), np.stack([k, after + 8, k + 8], 1)]
    )
    builder.add(face, place.world(np.concatenate(rings)), triangles)
