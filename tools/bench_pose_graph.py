"""Time the pose graph and count what it makes of wrong closures.

python tools/bench_pose_graph.py speed                   300, 3,000, 30,000 windows; 1 % closures
python tools/bench_pose_graph.py speed --isam 30000      iSAM2 up to that size, too: minutes
python tools/bench_pose_graph.py robust --seeds 5        wrong closures, by method

Drives in laps with known noise (tools/laps.py). CPU seconds of all threads; ATE in world units,
where neighbouring windows are 10 apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer
from laps import Drive, Plan, error, measure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from laser_slam.config import PoseGraphConfig
from laser_slam.dependencies import import_gtsam
from laser_slam.pose_graph import Link
from laser_slam.pose_graph.tangent import DIMENSIONS, from_gtsam, to_gtsam
from laser_slam.sim3 import Sim3

app = typer.Typer(add_completion=False, help=__doc__, pretty_exceptions_enable=False)
gtsam = import_gtsam()

Flags = NDArray[np.bool_]
Solution = tuple[list[Sim3], Flags]


@dataclass(frozen=True)
class Factors:
    """A drive's graph in GTSAM's hands, to solve it in other ways."""

    chain: Any
    closures: list[Any]
    start: Any
    inlier_probability: float = PoseGraphConfig().inlier_probability

    def solution(self, values: Any) -> Solution:
        """Return places and the closures that fit."""
        places = [from_gtsam(values.atSimilarity3(key)) for key in range(values.size())]
        bound = gtsam_bound(self.inlier_probability)
        return places, np.array([2 * factor.error(values) <= bound for factor in self.closures])


def gtsam_bound(probability: float) -> float:
    """Return the squared misfit that a right closure stays under."""
    from scipy.stats import chi2  # noqa: PLC0415

    return float(chi2.ppf(probability, DIMENSIONS))


def factor_of(link: Link) -> Any:
    """Make GTSAM's factor of a link."""
    noise = gtsam.noiseModel.Gaussian.Information(link.information)
    return gtsam.BetweenFactorSimilarity3(link.a, link.b, to_gtsam(link.a_from_b), noise)


def anchor(world_from_window: Sim3) -> Any:
    """Make the prior of the first window."""
    noise = gtsam.noiseModel.Isotropic.Sigma(DIMENSIONS, 1e-6)
    return gtsam.PriorFactorSimilarity3(0, to_gtsam(world_from_window), noise)


def factors_of(drive: Drive) -> Factors:
    """Make a graph of a drive that was not optimised yet."""
    registrations, closures = drive.graph().links
    chain, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    chain.push_back(anchor(drive.chained[0]))
    for link in registrations:
        chain.push_back(factor_of(link))
    for index, place in enumerate(drive.chained):
        start.insert(index, to_gtsam(place))
    return Factors(chain, [factor_of(link) for link in closures], start)


def joined(factors: Factors, closures: Sequence[Any]) -> Any:
    """Join the chain and some closures."""
    graph = gtsam.NonlinearFactorGraph(factors.chain)
    for factor in closures:
        graph.push_back(factor)
    return graph


def solve_with_kernel(name: str) -> Callable[[Drive], Solution]:
    """Fit with a robust kernel of width 1 (Huber: 1.345) on the closures, or with none."""
    kernels = gtsam.noiseModel.mEstimator
    kernel = {
        "Huber": lambda: kernels.Huber.Create(1.345),
        "Cauchy": lambda: kernels.Cauchy.Create(1.0),
    }

    def solve(drive: Drive) -> Solution:
        factors = factors_of(drive)
        closures = factors.closures
        if name in kernel:
            robust = gtsam.noiseModel.Robust
            closures = [
                f.cloneWithNewNoiseModel(robust.Create(kernel[name](), f.noiseModel()))
                for f in closures
            ]
        graph = joined(factors, closures)
        return factors.solution(gtsam.LevenbergMarquardtOptimizer(graph, factors.start).optimize())

    return solve


def solve_with_gnc(drive: Drive) -> Solution:
    """Fit with GTSAM's graduated non-convexity, Geman-McClure."""
    factors = factors_of(drive)
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.GM)
    parameters.setKnownInliers(list(range(factors.chain.size())))
    graph = joined(factors, factors.closures)
    optimizer = gtsam.GncLMOptimizer(graph, factors.start, parameters)
    optimizer.setInlierCostThresholdsAtProbability(factors.inlier_probability)
    return factors.solution(optimizer.optimize())


def solve_here(drive: Drive) -> Solution:
    """Fit as laser-slam does."""
    result = drive.graph().optimise()
    return list(result.world_from_window.values()), result.is_trusted


METHODS: dict[str, Callable[[Drive], Solution]] = {
    "no kernel": solve_with_kernel("none"),
    "Huber": solve_with_kernel("Huber"),
    "Cauchy": solve_with_kernel("Cauchy"),
    "GNC-GM": solve_with_gnc,
    "laser-slam": solve_here,
}


@app.command()
def robust(
    seeds: Annotated[int, typer.Option(help="drives per case")] = 3,
    num: Annotated[int, typer.Option(help="windows")] = 600,
    closures: Annotated[int, typer.Option(help="right and wrong")] = 24,
) -> None:
    """Compare methods at 0 to 60 % wrong closures, on chains that drift as they say, and more."""
    table = Table("growth", "wrong", "method", "right kept", "wrong kept", "ATE", "CPU s")
    for growth in (0.0, 0.005):
        for wrong in (0, closures // 8, closures // 3, 5 * closures // 8):
            plan = Plan(num, num // 6, closures, wrong, growth)
            for name, solve in METHODS.items():
                table.add_row(f"{growth:.1%}", str(wrong), name, *judge(plan, solve, seeds))
    Console(width=100).print(table)


def judge(plan: Plan, solve: Callable[[Drive], Solution], seeds: int) -> list[str]:
    """Return closures kept, the median ATE and the mean time over some drives."""
    kept, errors, seconds = np.zeros(2, dtype=np.int64), [], []
    for seed in range(seeds):
        drive = measure(plan, seed)
        start = time.process_time()
        places, is_trusted = solve(drive)
        seconds.append(time.process_time() - start)
        kept += [int((is_trusted & right).sum()) for right in (drive.is_right, ~drive.is_right)]
        errors.append(error(places, drive.truth))
    right = f"{kept[0]}/{seeds * (plan.closures - plan.wrong)}"
    wrong = f"{kept[1]}/{seeds * plan.wrong}"
    return [right, wrong, f"{np.median(errors):.2f}", f"{np.mean(seconds):.2f}"]


@app.command()
def speed(
    nums: Annotated[list[int] | None, typer.Option("--num", help="windows")] = None,
    isam: Annotated[int, typer.Option(help="largest graph for iSAM2")] = 3000,
) -> None:
    """Time building, solving, one more closure, and iSAM2."""
    table = Table("windows", "build s", "solve s", "rounds", "places s", "one more s", "iSAM2 s")
    table.add_column("per window / closure ms")
    table.add_column("its cost")
    for num in nums or [300, 3000, 30_000]:
        plan = Plan(num, max(num // 30, 50), num // 100)
        table.add_row(f"{num:,}", *time_batch(plan), *(time_isam(plan) if num <= isam else []))
    Console(width=120).print(table)


def time_batch(plan: Plan) -> list[str]:
    """Time a graph from its links to its places, then again with another closure."""
    drive = measure(plan, 0)
    marks = [time.process_time()]
    graph = drive.graph()
    marks.append(time.process_time())
    result = graph.optimise()
    marks.append(time.process_time())
    _ = graph.places
    marks.append(time.process_time())
    a, b, a_from_b, sigmas = drive.closures[0]
    graph.add_closure(a, b, a_from_b, 10 * sigmas)
    graph.optimise()
    marks.append(time.process_time())
    build, solve, read, more = np.diff(marks)
    texts = [f"{value:.2f}" for value in (build, solve - read, read, more)]
    return [*texts[:2], str(result.iterations), *texts[2:]]


def time_isam(plan: Plan) -> list[str]:
    """Time an incremental solver that is given every window, and every closure when it appears."""
    drive = measure(plan, 0)
    registrations, closures = drive.graph().links
    by_window: dict[int, list[Link]] = {}
    for link in closures:
        by_window.setdefault(link.b, []).append(link)
    solver = gtsam.ISAM2()
    plain: list[float] = []
    loop: list[float] = []
    add_to_isam(solver, [anchor(drive.chained[0])], 0, drive.chained[0])
    for link in registrations:
        started = time.process_time()
        place = from_gtsam(solver.calculateEstimateSimilarity3(link.a)) @ link.a_from_b
        new = [link, *by_window.get(link.b, [])]
        add_to_isam(solver, [factor_of(one) for one in new], link.b, place)
        (loop if len(new) > 1 else plain).append(time.process_time() - started)
    mean_ms = [1e3 * float(np.mean(part)) for part in (plain, loop)]
    factors = factors_of(drive)
    graph = joined(factors, factors.closures)
    cost = graph.error(solver.calculateEstimate()) / drive.graph().optimise().cost_after
    return [
        f"{sum(plain) + sum(loop):.2f}",
        f"{mean_ms[0]:.2f} / {mean_ms[1]:.0f}",
        f"{cost:.2f}",
    ]


def add_to_isam(solver: Any, factors: list[Any], index: int, place: Sim3) -> None:
    """Add a window and what links it."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in factors:
        graph.push_back(factor)
    values.insert(index, to_gtsam(place))
    solver.update(graph, values)


if __name__ == "__main__":
    app()
