"""Centre lines of the streets below a camera path, and how to find the nearest ones.

The car keeps to the right lane, so the centre line runs to the left of its path. Where the path
comes back to a street, the street of the first visit stays. Plan coordinates are world (x, z).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from laser_slam.datasets.synthetic.kernels import inlined, kernel

Array = NDArray[np.float64]

LANE_M = 1.75  # path to centre line
HALF_ROAD_M = 5.5  # two lanes and a strip for parked cars on each side
PAVEMENT_M = 2.2
SIDE_STREET_M = 70.0
APART_M = 32  # this far on, a street that goes straight is clear of the one that bends
CELL_M = 1.0
REACH_M = 16.0  # the lookup knows streets up to here


class Streets(NamedTuple):
    """Samples of all centre lines, one per metre, and a raster that finds the nearest.

    Attributes:
        points: (S, 2) plan coordinates.
        tangents: (S, 2) unit.
        arc: (S,) metres along the chain.
        chain: (S,) which street; samples of one chain are consecutive.
        nearest: (rows, columns) nearest sample of the cell's centre; -1: none in reach.
        crossing: (rows, columns) nearest sample of another street, or of this one elsewhere.
        origin: (2,) plan coordinates of the raster's corner.
    """

    points: Array
    tangents: Array
    arc: Array
    chain: NDArray[np.int64]
    nearest: NDArray[np.int32]
    crossing: NDArray[np.int32]
    origin: Array


def make_streets(world_from_cam: Array) -> Streets:
    """Lay streets below a (N, 4, 4) camera path, with side streets ahead of its turns."""
    chains = _kept_chains(_centre_line(world_from_cam))
    chains += _side_streets(chains)
    points = np.concatenate(chains)
    tangents = np.concatenate([_tangents(chain) for chain in chains])
    chain = np.repeat(np.arange(len(chains)), [len(c) for c in chains])
    arc = np.concatenate([np.arange(len(c), dtype=np.float64) for c in chains])
    arc += 37.0 * chain  # so that dashes and slabs of two streets are out of step
    return Streets(points, tangents, arc, chain, *_lookup(points, arc, chain))


def plan(world_from_cam: Array, spacing_m: float) -> Array:
    """Return the path in plan, (M, 2), evenly spaced; standing still is left out."""
    points = world_from_cam[:, [0, 2], 3]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.append(True, step > 1e-6)]
    arc = np.append(0.0, np.cumsum(step[step > 1e-6]))
    at = np.linspace(0.0, arc[-1], max(int(arc[-1] / spacing_m), 1) + 1)
    return np.stack([np.interp(at, arc, points[:, k]) for k in (0, 1)], axis=1)


def _tangents(points: Array) -> Array:
    step = np.gradient(points, axis=0) if len(points) > 1 else np.array([[0.0, 1.0]])
    return np.asarray(step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))


def _centre_line(world_from_cam: Array) -> Array:
    path = plan(world_from_cam, 1.0)
    if len(path) < 3:  # a camera that stands: the street is where it looks
        ahead = world_from_cam[0, [0, 2], 2]
        path = path[0] + np.arange(3)[:, None] * ahead
    tangents = _tangents(gaussian_filter1d(path, 3.0, axis=0, mode="nearest"))
    left = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    return np.asarray(gaussian_filter1d(path + LANE_M * left, 2.0, axis=0, mode="nearest"))


def _kept_chains(line: Array) -> list[Array]:
    """Cut out what runs along an earlier part of the line: the path comes back there."""
    tangents = _tangents(line)
    near = cKDTree(line).query_ball_point(line, 5.0)
    is_kept = np.ones(len(line), bool)
    for i, others in enumerate(near):
        earlier = np.array([j for j in others if j < i - 30 and is_kept[j]], int)
        if len(earlier):
            beside = np.abs((line[earlier] - line[i]) @ tangents[i]) < 1.0
            parallel = np.abs(tangents[earlier] @ tangents[i]) > 0.87
            is_kept[i] = not (beside & parallel).any()
    starts = np.flatnonzero(np.diff(np.concatenate([[0], is_kept.astype(int), [0]])))
    runs = [line[a:b] for a, b in zip(starts[::2], starts[1::2], strict=True)]
    return [run for run in runs if len(run) > 3] or [line]


def _side_streets(chains: list[Array]) -> list[Array]:
    """Go straight on at both ends of every turn and of every street, where there is room."""
    added: list[Array] = []
    for chain in chains:
        tangents = _tangents(gaussian_filter1d(chain, 1.0, axis=0, mode="nearest"))
        yaw = np.unwrap(np.arctan2(tangents[:, 0], tangents[:, 1]))
        starts = [(chain[-1], tangents[-1]), (chain[0], -tangents[0])]
        for a, b in _turns(yaw):
            starts += [(chain[a], tangents[a]), (chain[b], -tangents[b])]
        for start, ahead in starts:
            street = _street_with_room(start, ahead, [*chains, *added])
            if street is not None:
                added.append(street)
    return added


def _turns(yaw: Array) -> list[tuple[int, int]]:
    """Find stretches where the street bends by more than a right angle's half."""
    bends = np.abs(gaussian_filter1d(np.gradient(yaw), 2.0)) > 0.03
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bends.astype(int), [0]])))
    pairs = [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(a, b) for a, b in pairs if abs(yaw[b] - yaw[a]) > 0.8]


def _street_with_room(start: Array, ahead: Array, streets: list[Array]) -> Array | None:
    street = start + np.arange(int(SIDE_STREET_M))[:, None] * ahead
    distance, _ = cKDTree(np.concatenate(streets)).query(street[APART_M:])
    free = np.append(distance > 14.0, False)
    length = APART_M + int(np.argmin(free))
    return street[: length - 8] if length > APART_M + 12 else None


def _lookup(
    points: Array, arc: Array, chain: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int32], Array]:
    origin = points.min(axis=0) - REACH_M - 2.0
    columns, rows = np.ceil((points.max(axis=0) - origin + REACH_M + 2.0) / CELL_M).astype(int)
    tree = cKDTree(points)
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    centres = origin + (cells + 0.5) * CELL_M
    distance, _ = tree.query(centres, distance_upper_bound=REACH_M)
    reached = np.flatnonzero(np.isfinite(distance))
    count = min(48, len(points))
    found, index = tree.query(centres[reached], k=count, distance_upper_bound=REACH_M)
    first = index[:, 0]
    index = np.where(np.isfinite(found), index, first[:, None])
    elsewhere = np.abs(arc[index] - arc[first][:, None]) > 22.0
    elsewhere |= chain[index] != chain[first][:, None]
    other = np.where(elsewhere.any(axis=1), index[np.arange(len(index)), elsewhere.argmax(1)], -1)
    nearest, crossing = np.full((2, rows * columns), -1, np.int32)
    nearest[reached], crossing[reached] = first, other
    return nearest.reshape(rows, columns), crossing.reshape(rows, columns), origin


@kernel
def _beside(streets: Streets, sample: int, x: float, z: float) -> Any:
    """Return (lateral, along, sample): metres right of the centre line, metres along it."""
    best, lateral, along, at = 1e18, 1e9, 0.0, sample
    last = len(streets.arc) - 1
    for i in range(max(sample - 3, 0), min(sample + 3, last)):
        if streets.chain[i] != streets.chain[i + 1]:
            continue
        px, pz = streets.points[i, 0], streets.points[i, 1]
        sx, sz = streets.points[i + 1, 0] - px, streets.points[i + 1, 1] - pz
        length2 = max(sx * sx + sz * sz, 1e-12)
        w = min(max(((x - px) * sx + (z - pz) * sz) / length2, 0.0), 1.0)
        dx, dz = x - px - w * sx, z - pz - w * sz
        d2 = dx * dx + dz * dz
        if d2 < best:
            best, along, at = d2, streets.arc[i] + w, i
            lateral = np.copysign(np.sqrt(d2), dx * sz - dz * sx)
    return lateral, along, at


@inlined
def locate(streets: Streets, x: float, z: float) -> Any:
    """Find a plan point on the streets.

    Returns:
        Metres right of the nearest centre line (1e9: far from all), metres along it, its nearest
        sample, and the distance from the centre line of a street that crosses (1e9: none).
    """
    column, row = int((x - streets.origin[0]) / CELL_M), int((z - streets.origin[1]) / CELL_M)
    rows, columns = streets.nearest.shape
    if row < 0 or column < 0 or row >= rows or column >= columns:
        return 1e9, 0.0, 0, 1e9
    sample = streets.nearest[row, column]
    if sample < 0:
        return 1e9, 0.0, 0, 1e9
    lateral, along, at = _beside(streets, sample, x, z)
    other = streets.crossing[row, column]
    crossing = 1e9
    if other >= 0:
        crossing = abs(_beside(streets, other, x, z)[0])
    return lateral, along, at, crossing
