"""A drive in laps around a block, measured with known noise: what the pose graph is tried on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import PoseGraphConfig
from laser_slam.pose_graph import PoseGraph
from laser_slam.sim3 import Sim3, rotation_exp, umeyama
from laser_slam.types import Registration

Array = NDArray[np.float64]

# Of one link: radians, share of the lap's step of ten units, log-scale.
SIGMAS = np.repeat([2e-3, 2e-2, 5e-3], [3, 3, 1])
STEP = 10.0


@dataclass(frozen=True)
class Drive:
    """What is true and what was measured.

    Attributes:
        truth: ``world_from_window``.
        chained: ``world_from_window`` from the registrations alone.
        registrations: from the second window on, each to the one before.
        closures: windows a and b, ``a_from_b`` and its sigmas.
        is_right: (C,) the closures that tell the truth.
    """

    truth: list[Sim3]
    chained: list[Sim3]
    registrations: list[Registration]
    closures: list[tuple[int, int, Sim3, Array]]
    is_right: NDArray[np.bool_]

    def graph(
        self,
        config: PoseGraphConfig | None = None,
        *,
        right_only: bool = False,
        start: Sequence[Sim3] | None = None,
    ) -> PoseGraph:
        """Put all in a new graph, windows at their chained places or at others."""
        graph = PoseGraph(config or PoseGraphConfig())
        for index, place in enumerate(start or self.chained):
            graph.add_window(index, place)
        for index, registration in enumerate(self.registrations, start=1):
            graph.add_registration(index - 1, index, registration)
        for closure, is_right in zip(self.closures, self.is_right, strict=True):
            if is_right or not right_only:
                graph.add_closure(*closure)
        return graph


@dataclass(frozen=True)
class Plan:
    """A drive to measure.

    Attributes:
        num: windows.
        lap: windows per lap.
        closures: in all.
        wrong: of these, between places that have nothing to do with each other.
        growth: what each registration has wrong in log-scale, on top of the noise.
    """

    num: int = 200
    lap: int = 50
    closures: int = 12
    wrong: int = 0
    growth: float = 0.0


def sigmas_in(window: Sim3) -> Array:
    """Return the sigmas of a link whose previous window is given: the world's step is 10."""
    return np.asarray(SIGMAS / np.repeat([1.0, window.scale, 1.0], [3, 3, 1]))


def disturb(a_from_b: Sim3, sigmas: Array, rng: np.random.Generator) -> Sim3:
    """Measure with the noise that ``Registration.sigmas`` stands for."""
    noise = rng.normal(size=7) * sigmas
    return Sim3(
        a_from_b.scale * np.exp(noise[6]),
        rotation_exp(noise[:3]) @ a_from_b.rotation,
        a_from_b.translation + noise[3:6],
    )


def laps(plan: Plan, rng: np.random.Generator) -> list[Sim3]:
    """Drive in laps, each window in a unit of its own, the first one in the world's."""
    radius = STEP * plan.lap / (2 * np.pi)
    units = np.exp(0.3 * rng.normal(size=plan.num))
    angles = 2 * np.pi * np.arange(plan.num) / plan.lap
    return [
        Sim3(
            unit if row else 1.0,
            rotation_exp(np.array([0.0, -angle, 0.0])),
            radius * np.array([1 - np.cos(angle), 0.02 * np.sin(3 * angle), np.sin(angle)]),
        )
        for row, (unit, angle) in enumerate(zip(units, angles, strict=True))
    ]


def measure(plan: Plan, seed: int) -> Drive:
    """Measure a drive."""
    rng = np.random.default_rng(seed)
    truth = laps(plan, rng)
    chained, registrations = truth[:1], []
    for previous, current in pairwise(truth):
        sigmas = sigmas_in(previous)
        found = disturb(previous.inverse() @ current, sigmas, rng)
        found = Sim3(found.scale * np.exp(plan.growth), found.rotation, found.translation)
        chained.append(chained[-1] @ found)
        registrations.append(Registration(found, sigmas, 1000, 0.01))
    is_right = rng.permutation(np.arange(plan.closures) >= plan.wrong)
    closures = []
    for right in is_right:
        a, b = revisit(plan, rng) if right else elsewhere(plan, rng)
        sigmas = sigmas_in(truth[a])
        a_from_b = truth[a].inverse() @ truth[b] if right else Sim3()
        closures.append((a, b, disturb(a_from_b, sigmas, rng), sigmas))
    return Drive(truth, chained, registrations, closures, is_right)


def revisit(plan: Plan, rng: np.random.Generator) -> tuple[int, int]:
    """Return two windows at one place, some laps apart."""
    b = int(rng.integers(plan.lap, plan.num))
    return b - plan.lap * int(rng.integers(1, b // plan.lap + 1)), b


def elsewhere(plan: Plan, rng: np.random.Generator) -> tuple[int, int]:
    """Return two windows at least a quarter of a lap apart."""
    while True:
        a, b = sorted(rng.integers(0, plan.num, 2).tolist())
        if plan.lap / 4 < (b - a) % plan.lap < 3 * plan.lap / 4:
            return a, b


def error(found: Iterable[Sim3], truth: Sequence[Sim3]) -> float:
    """Return the ATE after a Sim(3) alignment, in world units."""
    places, true_places = (np.array([s.translation for s in part]) for part in (found, truth))
    offsets = umeyama(places, true_places).apply(places) - true_places
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))
