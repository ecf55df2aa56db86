"""What stands where: nothing on the streets, nothing on the camera's path, nothing twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from laser_slam.datasets.synthetic import furniture, houses, plants, vehicles
from laser_slam.datasets.synthetic.mesh import MeshBuilder, Placement
from laser_slam.datasets.synthetic.streets import HALF_ROAD_M, PAVEMENT_M, Streets, plan
from laser_slam.datasets.synthetic.terrain import MARGIN_M, Terrain

Array = NDArray[np.float64]

CELL_M = 0.5
PATH_CLEARANCE_M = 1.75  # half a car and a hand's breadth
EDGE_M = HALF_ROAD_M + PAVEMENT_M  # from the centre line to the gardens


class Occupancy:
    """A raster of what is taken, over the whole world."""

    def __init__(self, terrain: Terrain, world_from_cam: Array) -> None:
        self._terrain = terrain
        rows, columns = terrain.ground_y.shape
        extent = np.array([columns, rows]) * 2.0
        shape = (int(extent[1] / CELL_M) + 1, int(extent[0] / CELL_M) + 1)
        self._taken = np.zeros(shape, bool)
        self._far_from_path = np.ones(shape, bool)
        path = np.concatenate([plan(world_from_cam, 0.25), world_from_cam[:, [0, 2], 3]])
        at = self._cells(path)
        self._far_from_path[at[:, 1], at[:, 0]] = False
        distance = distance_transform_edt(self._far_from_path)
        self._taken |= distance * CELL_M < PATH_CLEARANCE_M + 0.5 * CELL_M

    def take(self, place: Placement, size: tuple[float, float], street_m: float) -> bool:
        """Take a rectangle of (width, depth) metres, centred on ``place``, if all of it is free.

        Args:
            place: centre and direction; the width lies along the object's right axis.
            size: metres.
            street_m: the distance that all of it must keep from every centre line, metres.
        """
        width, depth = size
        x = np.linspace(-width / 2, width / 2, max(int(width / 0.4), 2) + 1)
        z = np.linspace(-depth / 2, depth / 2, max(int(depth / 0.4), 2) + 1)
        local = np.zeros((len(x) * len(z), 3))
        local[:, [0, 2]] = np.stack(np.meshgrid(x, z), axis=-1).reshape(-1, 2)
        points = place.world(local)[:, [0, 2]]
        at = self._cells(points)
        height, breadth = self._taken.shape
        if (at < 0).any() or (at[:, 0] >= breadth).any() or (at[:, 1] >= height).any():
            return False
        if self._taken[at[:, 1], at[:, 0]].any():
            return False
        if float(self._terrain.street_distance(points).min()) < street_m:
            return False
        self._taken[at[:, 1], at[:, 0]] = True
        return True

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return np.floor((points - self._terrain.origin) / CELL_M).astype(np.int64)


class Layout:
    """Furnish the world, street by street."""

    def __init__(
        self, builder: MeshBuilder, terrain: Terrain, streets: Streets, world_from_cam: Array
    ) -> None:
        self._builder = builder
        self._terrain = terrain
        self._streets = streets
        self._occupancy = Occupancy(terrain, world_from_cam)

    def furnish(self, seed: int) -> None:
        """Add everything that stands on the ground."""
        rng = np.random.default_rng((seed, 4))
        chains = [np.flatnonzero(self._streets.chain == c) for c in np.unique(self._streets.chain)]
        for rows in chains:
            self._close_ends(rows, rng)
        for rows in chains:
            for side in (-1.0, 1.0):
                self._add_houses(rows, side, rng)
        for rows in chains:
            for side in (-1.0, 1.0):
                self._add_roadside(rows, side, rng)
                self._add_cars(rows, side, rng)
        self._add_background(rng)

    def _place(
        self, sample: int, lateral: float, along: float = 0.0, turn: float = 0.0
    ) -> Placement:
        """Stand ``lateral`` metres right of a centre line, facing it; ``turn`` in radians."""
        tangent = self._streets.tangents[sample]
        right = np.array([tangent[1], -tangent[0]])
        spot = self._streets.points[sample] + lateral * right + along * tangent
        front = -np.sign(lateral) * right if lateral else -tangent
        yaw = float(np.arctan2(front[0], front[1])) + turn
        ground = float(self._terrain.at(spot[None])[0])
        return Placement(np.array([spot[0], ground, spot[1]]), yaw)

    def _add_houses(self, rows: NDArray[np.int64], side: float, rng: np.random.Generator) -> None:
        at = float(rng.uniform(0, 4))
        while at < len(rows) - 1:
            size = houses.draw_size(rng)
            setback = EDGE_M + float(rng.choice([0.4, 2.0, 3.5, 5.0]) + rng.uniform(0, 0.8))
            middle = min(int(at + size.width / 2), len(rows) - 1)
            place = self._place(rows[middle], side * setback)
            if self._take_house(place, size):
                has_bay = setback > EDGE_M + 2.0 and size.width > 8 and rng.random() < 0.5
                houses.add_house(self._builder, place, replace(size, has_bay=has_bay), rng)
                self._add_garden(rows[middle], side, setback, size.width, rng)
                gap = 0.3 if rng.random() < 0.35 else float(rng.uniform(2.0, 7.0))
                at += size.width + gap
            else:
                at += 1.5

    def _take_house(self, place: Placement, size: houses.HouseSize) -> bool:
        centre = Placement(place.world(np.array([0.0, 0.0, -size.depth / 2])), place.yaw)
        return self._occupancy.take(centre, (size.width, size.depth), EDGE_M - 0.6)

    def _add_garden(
        self, sample: int, side: float, setback: float, width: float, rng: np.random.Generator
    ) -> None:
        """Edge the garden with a hedge or a wall beside the gate, and plant a shrub."""
        if setback < EDGE_M + 2.0:
            return
        for half in (-1.0, 1.0):
            length = width / 2 - 0.8
            place = self._place(sample, side * (EDGE_M + 0.45), half * (length / 2 + 0.8))
            centre = Placement(place.world(np.array([0.0, 0.0, -0.3])), place.yaw)
            if not self._occupancy.take(centre, (length, 0.5), EDGE_M - 0.6):
                continue
            kind = rng.random()
            if kind < 0.5:
                height = float(rng.uniform(0.8, 1.8))
                plants.add_hedge(self._builder, place, (length, height), rng)
            elif kind < 0.85:
                houses.add_garden_wall(self._builder, place, length, rng)
        place = self._place(sample, side * (setback - 1.0), float(rng.uniform(-3, 3)))
        if self._occupancy.take(place, (1.0, 1.0), EDGE_M):
            plants.add_shrub(self._builder, place, float(rng.uniform(0.4, 0.9)), rng)

    def _add_roadside(self, rows: NDArray[np.int64], side: float, rng: np.random.Generator) -> None:
        """Add street trees, lamps, signs and bollards along the pavement."""
        avenue = rng.random() < 0.6
        at = float(rng.uniform(2, 8))
        while at < len(rows):
            sample = rows[int(at)]
            kind = rng.random()
            lateral = side * (HALF_ROAD_M + 0.5)
            if kind < (0.5 if avenue else 0.25):
                self._try_tree(self._place(sample, lateral), float(rng.uniform(4.5, 8.5)), 2, rng)
            elif kind < 0.85:
                turn = float(rng.choice([-1, 1])) * np.pi / 2
                place = self._place(sample, lateral, turn=0.0 if kind < 0.65 else turn)
                if self._occupancy.take(place, (0.5, 0.5), HALF_ROAD_M - 0.6):
                    add = furniture.add_lamp if kind < 0.65 else furniture.add_sign
                    (add if kind < 0.78 else furniture.add_bollard)(self._builder, place, rng)
            at += float(rng.uniform(4.0, 11.0))
        for at in np.arange(rng.uniform(0, 5), len(rows), 4.0):  # what the houses left free
            lateral = side * (EDGE_M + float(rng.uniform(0.9, 6.0)))
            place = self._place(rows[int(at)], lateral)
            if rng.random() < 0.55:
                self._try_tree(place, float(rng.uniform(4, 10)), 2, rng)
            elif self._occupancy.take(place, (1.6, 1.6), EDGE_M):
                plants.add_shrub(self._builder, place, float(rng.uniform(0.5, 1.2)), rng)

    def _try_tree(
        self, place: Placement, height: float, detail: int, rng: np.random.Generator
    ) -> None:
        side = 1.2 if detail > 1 else 0.5 * height
        if self._occupancy.take(place, (side, side), HALF_ROAD_M - 0.9):
            plants.add_tree(self._builder, place, height, rng, detail)

    def _add_cars(self, rows: NDArray[np.int64], side: float, rng: np.random.Generator) -> None:
        at = float(rng.uniform(3, 12))
        while at < len(rows) - 3:
            lateral = side * (HALF_ROAD_M - 1.02 + float(rng.uniform(-0.06, 0.06)))
            turn = np.pi / 2 * (1.0 if rng.random() < 0.85 else -1.0) + float(rng.normal(0, 0.015))
            place = self._place(rows[int(at)], lateral, turn=turn)
            if self._occupancy.take(place, (1.9, 5.0), HALF_ROAD_M - 3.2):
                vehicles.add_car(self._builder, place, rng)
                at += 5.6 + (0.0 if rng.random() < 0.55 else float(rng.exponential(12.0)))
            else:
                at += 1.5

    def _close_ends(self, rows: NDArray[np.int64], rng: np.random.Generator) -> None:
        """Close the view along a street where it ends: a wide house and trees."""
        for end, sign in ((rows[-1], 1.0), (rows[0], -1.0)):
            turn = 0.0 if sign > 0 else np.pi
            place = self._place(end, 0.0, sign * (EDGE_M + 4.0), turn)
            width, depth = rng.uniform(14, 20), rng.uniform(8, 10)
            size = houses.HouseSize(
                float(width),
                float(depth),
                int(rng.integers(2, 5)),
                str(rng.choice(["along", "hip"])),
            )
            if self._take_house(place, size):
                houses.add_house(self._builder, place, size, rng)
            for offset in (-14.0, 14.0):
                tree = Placement(place.world(np.array([offset, 0.0, 0.0])), place.yaw)
                self._try_tree(self._grounded(tree), float(rng.uniform(7, 11)), 1, rng)

    def _grounded(self, place: Placement) -> Placement:
        origin = place.origin.copy()
        origin[1] = float(self._terrain.at(origin[None, [0, 2]])[0])
        return Placement(origin, place.yaw)

    def _add_background(self, rng: np.random.Generator) -> None:
        """Scatter trees and taller houses behind the first row: they close the horizon."""
        rows, columns = self._terrain.ground_y.shape
        extent = np.array([columns, rows]) * 2.0
        grid = np.stack(np.meshgrid(*(np.arange(4.0, e - 4.0, 10.0) for e in extent)), axis=-1)
        spots = grid.reshape(-1, 2) + rng.uniform(-3.5, 3.5, (grid[..., 0].size, 2))
        spots += self._terrain.origin
        distance = self._terrain.street_distance(spots)
        for spot, away in zip(spots, distance, strict=True):
            if not 19.0 < away < MARGIN_M - 45.0:
                continue
            place = self._grounded(
                Placement(np.array([spot[0], 0.0, spot[1]]), float(rng.uniform(0, 2 * np.pi)))
            )
            if rng.random() < 0.2:
                width, depth = rng.uniform(9, 18), rng.uniform(8, 11)
                storeys = int(rng.integers(2, 6))
                size = houses.HouseSize(
                    float(width), float(depth), storeys, str(rng.choice(["hip", "along", "flat"]))
                )
                if self._take_house(place, size):
                    houses.add_house(self._builder, place, size, rng)
            elif rng.random() < 0.8:
                self._try_tree(place, float(rng.uniform(6, 13)), 1, rng)
