"""The graph of windows: places, links and what is known of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from laser_slam.config import PoseGraphConfig
from laser_slam.dependencies import import_gtsam
from laser_slam.errors import DegenerateGeometryError
from laser_slam.pose_graph.solving import Problem, solve
from laser_slam.pose_graph.tangent import (
    DIMENSIONS,
    from_gtsam,
    local_information,
    parent_sigmas,
    to_gtsam,
)
from laser_slam.sim3 import Sim3
from laser_slam.types import Registration

Array = NDArray[np.float64]

_ASYMMETRY = 1e-9  # of an information, from rounding
_ANCHOR_SIGMA = 1e-6  # the first window is the world: as good as fixed


@dataclass(frozen=True)
class Link:
    """A measured similarity between two windows.

    Attributes:
        a: index of a window.
        b: index of another.
        a_from_b: measured.
        information: (7, 7) inverse covariance in GTSAM's tangent: rotation, translation, log-scale
            in b's axes and units.
    """

    a: int
    b: int
    a_from_b: Sim3
    information: Array


@dataclass(frozen=True)
class Optimised:
    """What an optimisation found.

    Attributes:
        world_from_window: of every window, by index.
        is_trusted: (C,) the closures that it rests on, in the order in which they were added.
        misfits: (C,) how far each closure is off, in sigmas; 2 to 4 is usual, for 7 numbers each.
        cost_before: half the sum of squared misfits of registrations and trusted closures.
        cost_after: the same after the optimisation.
        iterations: of the solver.
    """

    world_from_window: Mapping[int, Sim3]
    is_trusted: NDArray[np.bool_]
    misfits: Array
    cost_before: float
    cost_after: float
    iterations: int


class PoseGraph:
    """Windows linked by registrations and closures; the first window stays where it is.

    Factors are made once and kept; an optimisation starts from the last one's places.
    """

    def __init__(self, config: PoseGraphConfig) -> None:
        gtsam = import_gtsam()
        self._config = config
        self._chain = gtsam.NonlinearFactorGraph()
        self._closures: list[Any] = []
        self._left_out: NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)
        self._values = gtsam.Values()
        self._rows: dict[int, int] = {}  # by index of window, in the order of addition
        self._chain_rows: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def places(self) -> dict[int, Sim3]:
        """Return ``world_from_window`` by index, in the order in which windows were added."""
        return {index: self._place(index) for index in self._rows}

    @property
    def links(self) -> tuple[list[Link], list[Link]]:
        """Return the registrations and the trusted closures, each as they were added."""
        chain = [_link(self._chain.at(i)) for i in range(1, self._chain.size())]  # 0: the anchor
        return chain, [_link(factor) for factor in self._trusted()]

    def add_window(self, index: int, world_from_window: Sim3) -> None:
        """Add a window with its place so far; the first one added is the anchor.

        Raises:
            DegenerateGeometryError: the window is there already.
        """
        if index in self._rows:
            raise DegenerateGeometryError(f"window {index} is in the pose graph already")
        place = to_gtsam(world_from_window)
        if not self._rows:
            gtsam = import_gtsam()
            noise = gtsam.noiseModel.Isotropic.Sigma(DIMENSIONS, _ANCHOR_SIGMA)
            self._chain.push_back(gtsam.PriorFactorSimilarity3(index, place, noise))
        self._values.insert(index, place)
        self._rows[index] = len(self._rows)

    def add_registration(self, previous: int, current: int, registration: Registration) -> None:
        """Link neighbouring windows; such a link is never doubted.

        Raises:
            DegenerateGeometryError: a window is unknown, or a sigma is not positive and finite.
        """
        measured = registration.previous_from_current
        self.add_link(_measured_link(previous, current, measured, registration.sigmas))

    def add_closure(self, a: int, b: int, a_from_b: Sim3, sigmas: Array) -> None:
        """Link windows that saw the same place; the optimisation decides whether to trust it.

        Args:
            a: index of a window.
            b: index of another.
            a_from_b: measured.
            sigmas: (7,) as in ``Registration.sigmas``, a being the previous window.

        Raises:
            DegenerateGeometryError: a window is unknown, or a sigma is not positive and finite.
        """
        self.add_link(_measured_link(a, b, a_from_b, sigmas), is_closure=True)

    def drop_closure(self) -> None:
        """Take the closure that was added last out again, as one that cannot be optimised."""
        self._closures.pop()
        self._left_out = self._left_out[:-1]

    def add_link(self, link: Link, *, is_closure: bool = False) -> None:
        """Add a link with its full information, as a g2o file has it.

        Raises:
            DegenerateGeometryError: a window is unknown or linked to itself, or the information
                is not symmetric and positive definite.
        """
        for index in (link.a, link.b):
            if index not in self._rows:
                raise DegenerateGeometryError(f"window {index} is not in the pose graph")
        if link.a == link.b:
            raise DegenerateGeometryError(f"window {link.a} cannot be linked to itself")
        gtsam = import_gtsam()
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(_root(link))
        measured = to_gtsam(link.a_from_b)
        factor = gtsam.BetweenFactorSimilarity3(link.a, link.b, measured, noise)
        if is_closure:
            self._closures.append(factor)
            self._left_out = np.append(self._left_out, False)
        else:
            self._chain.push_back(factor)
            self._chain_rows.append((self._rows[link.a], self._rows[link.b]))

    def optimise(self) -> Optimised:
        """Find the places that fit all registrations and the closures that can be trusted.

        Raises:
            DegenerateGeometryError: registrations leave a window unlinked, or the solver fails.
        """
        self._check_chain()
        problem = Problem(self._chain, self._closures, self._config)
        start = self._values
        found = solve(problem, start, self._left_out)
        # First what may raise: a fit without places leaves the graph as it was.
        places = {index: from_gtsam(found.values.atSimilarity3(index)) for index in self._rows}
        self._values, self._left_out = found.values, ~found.is_trusted
        return Optimised(
            world_from_window=places,
            is_trusted=found.is_trusted,
            misfits=np.sqrt(found.misfits),
            cost_before=problem.cost(start, found.is_trusted),
            cost_after=found.cost,
            iterations=found.iterations,
        )

    def marginal_sigmas(self, indices: Iterable[int]) -> dict[int, Array]:
        """Return how sure the places are, with the closures that the last optimisation trusts.

        Returns:
            (7,) by index, in the world's axes and units: rotation (radians), translation,
            log-scale.

        Raises:
            DegenerateGeometryError: registrations leave a window unlinked, or rounding leaves no
                covariance.
        """
        self._check_chain()
        gtsam = import_gtsam()
        graph = gtsam.NonlinearFactorGraph(self._chain)
        for factor in self._trusted():
            graph.push_back(factor)
        try:
            marginals = gtsam.Marginals(graph, self._values)
            covariances = {index: marginals.marginalCovariance(index) for index in indices}
        except RuntimeError as error:  # what GTSAM raises for a singular system
            raise DegenerateGeometryError("the pose graph has no covariance") from error
        return {
            index: parent_sigmas(self._place(index), covariance)
            for index, covariance in covariances.items()
        }

    def _place(self, index: int) -> Sim3:
        return from_gtsam(self._values.atSimilarity3(index))

    def _trusted(self) -> list[Any]:
        flagged = zip(self._closures, self._left_out, strict=True)
        return [factor for factor, is_left_out in flagged if not is_left_out]

    def _check_chain(self) -> None:
        """Refuse windows without a chain of registrations: closures may turn out wrong."""
        num = len(self._rows)
        if num == 0:
            raise DegenerateGeometryError("a pose graph needs a window")
        a, b = np.array(self._chain_rows, dtype=np.int64).reshape(-1, 2).T
        links = coo_array((np.ones(len(a)), (a, b)), shape=(num, num))
        _, part = connected_components(links, directed=False)
        if (part != part[0]).any():
            lost = list(self._rows)[int(np.argmax(part != part[0]))]
            raise DegenerateGeometryError(
                f"no chain of registrations leads to window {lost}; add the missing one"
            )


def _measured_link(a: int, b: int, a_from_b: Sim3, sigmas: Array) -> Link:
    return Link(a, b, a_from_b, local_information(a_from_b, sigmas))


def _link(factor: Any) -> Link:
    a, b = factor.keys()
    root = factor.noiseModel().R()
    return Link(a, b, from_gtsam(factor.measured()), root.T @ root)


def _root(link: Link) -> Array:
    """Return the (7, 7) triangular root of a link's information."""
    information = link.information
    try:
        if information.shape != (DIMENSIONS, DIMENSIONS) or not np.isfinite(information).all():
            raise np.linalg.LinAlgError
        if np.abs(information - information.T).max() > _ASYMMETRY * np.abs(information).max():
            raise np.linalg.LinAlgError
        return np.asarray(np.linalg.cholesky(information).T)
    except np.linalg.LinAlgError:
        raise DegenerateGeometryError(
            f"the information of the link from window {link.a} to {link.b} is not a finite, "
            "symmetric, positive definite 7x7 matrix"
        ) from None
