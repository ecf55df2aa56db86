"""Find the places of all windows, and which closures to trust.

A closure is trusted or left out whole; robust kernels only help to decide. If all closures agree
with the chain, the plain fit says so. If not, Cauchy's kernel decides, and what it leaves out gets
a second chance with sigmas of the chain that are taken for too small: real drift is no random
walk, so the chain errs by more than it says, but closures that agree are right none the less.

Differs from graduated non-convexity (Yang et al., RA-L 2020; GTSAM has it), the usual second
opinion: that starts from the fit to all closures, where wrong ones tie the chain in knots, and on
drifting chains it left right closures out where this keeps them (tools/bench_pose_graph.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from laser_slam.config import PoseGraphConfig
from laser_slam.dependencies import import_gtsam
from laser_slam.errors import DegenerateGeometryError
from laser_slam.pose_graph.tangent import DIMENSIONS

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_SETTLING_ROUNDS = 10
_WITNESSES = 2  # closures that must agree to stretch the chain all the way
_TOLERANCE = 1e-7  # of the cost; coarser, and a fit stops in the knots of wrong closures


@dataclass(frozen=True)
class Problem:
    """The factors of a graph; GTSAM's, all without robust kernel.

    Attributes:
        chain: prior and registrations.
        closures: one factor each.
        config: limits.
        doubt: how many times too small the chain's sigmas are taken to be. What counts is the
            ratio to the closures' sigmas, so it is those that are divided.
    """

    chain: Any
    closures: Sequence[Any]
    config: PoseGraphConfig
    doubt: float = 1.0

    @property
    def bound(self) -> float:
        """Return the squared misfit, in sigmas, that a right closure stays under."""
        return float(chi2.ppf(self.config.inlier_probability, DIMENSIONS))

    def graph(self, closures: Sequence[Any]) -> Any:
        """Return GTSAM's graph of the chain and these factors."""
        out = import_gtsam().NonlinearFactorGraph(self.chain)
        for factor in closures:
            out.push_back(factor)
        return out

    def weighted(self, is_chosen: Flags) -> list[Any]:
        """Return the factors of some closures, their sigmas divided by the doubt."""
        chosen = [self.closures[row] for row in np.flatnonzero(is_chosen).tolist()]
        if self.doubt == 1:
            return chosen
        noise_model = import_gtsam().noiseModel.Gaussian
        roots = [self.doubt * factor.noiseModel().R() for factor in chosen]
        return [
            factor.cloneWithNewNoiseModel(noise_model.SqrtInformation(root))
            for factor, root in zip(chosen, roots, strict=True)
        ]

    def misfits(self, values: Any) -> Array:
        """Return the (C,) squared misfit of each closure, in sigmas."""
        return np.array([2 * factor.error(values) for factor in self.closures])

    def cost(self, values: Any, is_trusted: Flags) -> float:
        """Return half the sum of squared misfits of chain and trusted closures."""
        return float(self.chain.error(values) + self.misfits(values)[is_trusted].sum() / 2)


@dataclass(frozen=True)
class Fit:
    """A least-squares solution.

    Attributes:
        values: GTSAM's, of all nodes.
        is_trusted: (C,) closures that were used.
        misfits: (C,) squared, in sigmas, of all closures.
        cost: half the sum of squared misfits of chain and trusted closures.
        iterations: of the solver, all stages that led here.
    """

    values: Any
    is_trusted: Flags
    misfits: Array
    cost: float
    iterations: int


def solve(problem: Problem, start: Any, left_out: Flags) -> Fit:
    """Find places and trusted closures.

    Args:
        problem: the factors.
        start: GTSAM's values of all nodes.
        left_out: (C,) closures that an earlier call decided to leave out.

    Raises:
        DegenerateGeometryError: the solver fails.
    """
    plain = fit(problem, start, ~left_out)
    if not problem.config.robust or _agrees(problem, plain):
        return plain
    chosen = _decide(problem, start)
    if not (~chosen.is_trusted & ~left_out).any():
        return chosen
    most = problem.config.max_stretch
    for doubt in (most**0.5, most):
        second = _decide(replace(problem, doubt=doubt), start)
        second = fit(problem, second.values, second.is_trusted, iterations=second.iterations)
        chosen = _better(problem, chosen, second)
    return chosen


def fit(problem: Problem, start: Any, is_trusted: Flags, *, iterations: int = 0) -> Fit:
    """Fit chain and trusted closures, no kernel; ``iterations`` were spent before."""
    values, rounds = _minimise(problem, start, problem.weighted(is_trusted))
    misfits = problem.misfits(values)
    cost = float(problem.chain.error(values) + misfits[is_trusted].sum() / 2)
    return Fit(values, is_trusted, misfits, cost, iterations + rounds)


def _agrees(problem: Problem, plain: Fit) -> bool:
    """Tell whether the trusted closures fit, all and each, and those left out still don't."""
    num = int(plain.is_trusted.sum())
    fits = plain.misfits <= problem.bound
    whole = chi2.ppf(problem.config.inlier_probability, DIMENSIONS * num) if num else np.inf
    return bool((fits == plain.is_trusted).all() and 2 * plain.cost <= whole)


def _decide(problem: Problem, start: Any) -> Fit:
    """Find the closures that Cauchy's kernel trusts, and those that fit once these are in."""
    current = _fit_cauchy(problem, start)
    for _round in range(_SETTLING_ROUNDS):
        current = fit(problem, current.values, current.is_trusted, iterations=current.iterations)
        choice = current.is_trusted & (current.misfits <= problem.bound)
        if (choice == current.is_trusted).all():
            choice = choice | (_surprises(problem, current) <= problem.bound)
        if (choice == current.is_trusted).all():
            break
        current = replace(current, is_trusted=choice)
    return current


def _fit_cauchy(problem: Problem, start: Any) -> Fit:
    noise_model = import_gtsam().noiseModel
    kernel = noise_model.mEstimator.Cauchy.Create(problem.doubt * problem.config.cauchy_width)
    robust = [
        factor.cloneWithNewNoiseModel(noise_model.Robust.Create(kernel, factor.noiseModel()))
        for factor in problem.weighted(np.ones(len(problem.closures), dtype=np.bool_))
    ]
    values, rounds = _minimise(problem, start, robust)
    misfits = problem.misfits(values)
    return Fit(values, misfits <= problem.bound, misfits, np.inf, rounds)


def _surprises(problem: Problem, current: Fit) -> Array:
    """Return the (C,) squared misfits, in sigmas of closure and chain together; trusted: infinite.

    That is twice what a closure would add to the cost of a new fit: a closure may be far off only
    because the windows that it links are not known better yet. All are infinite where wrong
    closures have tied the chain in knots that leave it no covariance.
    """
    out = np.full(len(problem.closures), np.inf)
    if current.is_trusted.all():
        return out
    gtsam = import_gtsam()
    graph = problem.graph(problem.weighted(current.is_trusted))
    try:
        marginals = gtsam.Marginals(graph, current.values)
        doubted = np.flatnonzero(~current.is_trusted).tolist()
        keys_of = {row: problem.closures[row].keys() for row in doubted}
        joints = {
            row: marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
            for row, keys in keys_of.items()
        }
    except RuntimeError:  # what GTSAM raises for a singular system
        return out
    for row, joint in joints.items():
        factor, keys = problem.closures[row], keys_of[row]
        covariance = np.block([[joint.at(a, b) for b in keys] for a in keys])
        jacobian, residual = factor.linearize(current.values).jacobian()
        spread = problem.doubt**2 * jacobian @ covariance @ jacobian.T
        out[row] = residual @ np.linalg.solve(np.eye(DIMENSIONS) + spread, residual)
    return out


def _better(problem: Problem, cautious: Fit, second: Fit) -> Fit:
    """Prefer what more closures agree on, unless the chain would have to give way too far for it.

    How far is measured in the chain's sigmas; one closure that nothing else speaks for is allowed
    half of it.
    """
    gained = int(second.is_trusted.sum()) - int(cautious.is_trusted.sum())
    if gained <= 0:
        return cautious
    stretch = np.sqrt(2 * max(second.cost - cautious.cost, 0.0) / (DIMENSIONS * gained))
    limit = problem.config.max_stretch * min(1.0, gained / _WITNESSES)
    return second if stretch <= limit else cautious


def _minimise(problem: Problem, start: Any, closures: Sequence[Any]) -> tuple[Any, int]:
    """Run Levenberg-Marquardt; return values and rounds."""
    gtsam = import_gtsam()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(problem.config.max_iterations)
    parameters.setRelativeErrorTol(_TOLERANCE)
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(problem.graph(closures), start, parameters)
        values = optimizer.optimize()
    except RuntimeError as error:  # what GTSAM raises for a singular system
        reason = (str(error).strip().splitlines() or ["singular"])[0]
        raise DegenerateGeometryError(f"the pose graph cannot be solved: {reason}") from error
    return values, int(optimizer.iterations())
