"""Drive along KITTI's trajectories without images, close loops, and count what wrong ones do.

python tools/simulate_loops.py poses/                      all of a folder: 00.txt ... 10.txt
python tools/simulate_loops.py poses/ --only 00,05 --wrong 0,0.1,0.3,0.5
python tools/simulate_loops.py poses/ --group 3            wrong closures come in agreeing threes
python tools/simulate_loops.py poses/ --set backbone.simulated.layer_sigma=0.15

A city is generated along each trajectory; the simulated backbone gives true depth and poses of
its windows with the errors of networks, no images. Chaining, loop windows and pose graph are the
real ones. Revisits are the true ones; wrong closures go straight into the graph, past all checks.
ATE: rmse in metres after a Sim(3) alignment. Plain: every closure is trusted, least squares.
Seconds: CPU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from loop_drives import Outcome, Stopwatch, chain_drive, close_loops, measure_revisits
from revisits import RevisitRule, invent_closures
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from laser_slam.config import Config, load_config
from laser_slam.datasets.synthetic.paths import read_kitti_poses
from laser_slam.errors import LaserSlamError
from laser_slam.sim3 import Array

# Errors of the backbone, the same for all sequences, so that chaining without closures drifts as
# ORB-SLAM2 without loop closure does in the paper's table (mean without 01: 26.5 m).
SETTINGS = (
    "backbone.name=simulated",
    "layers.enabled=never",
    "synthetic.width=126",
    "synthetic.height=42",
    "backbone.simulated.width=126",
)
HIGHWAY = "01"  # left out of the second mean, as in the publications
MIN_WRONG_OF = 10  # sequences with fewer revisits get wrong closures as if they had so many
# Published ATE, metres, after a Sim(3) alignment: the LASER paper (arXiv:2512.13680), tables.
SEQUENCES = ("00", "01", "02", "03", "04", "05", "06", "07", "08", "09", "10")
# fmt: off
PUBLISHED = {
    "ORB-SLAM2 w/o loops":
        (40.65, 502.20, 47.82, 0.94, 1.30, 29.95, 40.82, 16.04, 43.09, 38.77, 5.42),
    "ORB-SLAM2": (6.03, 508.34, 14.76, 1.02, 1.57, 4.04, 11.16, 2.19, 38.85, 8.39, 6.63),
    "VGGT-Long": (8.67, 121.17, 32.08, 6.12, 4.23, 8.31, 5.34, 4.63, 53.10, 41.99, 18.37),
    "pi3-Long": (6.28, 173.45, 63.92, 4.96, 1.66, 6.11, 4.89, 3.99, 36.08, 14.78, 21.84),
    "LASER pi3": (6.14, 121.61, 59.87, 2.64, 1.36, 2.73, 2.92, 2.28, 33.14, 17.95, 15.20),
}
# fmt: on
Case = tuple[float, bool]  # share of wrong closures, robust decision


@dataclass(frozen=True)
class Result:
    """What a sequence gave.

    Attributes:
        name: of the sequence.
        frames: of the drive.
        windows: of its keyframes.
        path_m: true length.
        chained_m: ATE without closures.
        off: (M, 2) degrees and metres by which measured closures are wrong.
        outcomes: by share of wrong closures and robust decision.
        seconds: CPU, by what was done.
    """

    name: str
    frames: int
    windows: int
    path_m: float
    chained_m: float
    off: Array
    outcomes: Mapping[Case, Outcome]
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Plan:
    """What is done with each sequence.

    Attributes:
        shares: of wrong closures among all, each a case of its own.
        group: wrong closures in a row that agree.
        rule: which pairs are revisits.
    """

    shares: tuple[float, ...]
    group: int
    rule: RevisitRule


def simulate(poses: Path, config: Config, plan: Plan, progress: Progress) -> Result:
    """Chain a drive and close its loops in every way of the plan."""
    task = progress.add_task(poses.stem, total=len(read_kitti_poses(poses)) - 1)
    clock = Stopwatch()
    drive = chain_drive(poses, config, clock, lambda frames: progress.advance(task, frames))
    progress.update(task, description=f"{poses.stem}: loops", completed=0, total=None)
    right, off = measure_revisits(drive, plan.rule, clock)
    outcomes = {}
    for share in plan.shares:
        num = int(np.ceil(share / (1 - share) * max(len(right), MIN_WRONG_OF)))
        nodes, truth = drive.slam.nodes, drive.truth
        closures = [*right, *invent_closures(num, nodes, truth, right, plan.group)]
        for robust in (True, False):
            outcomes[share, robust] = close_loops(drive, closures, with_decision(config, robust))
    progress.remove_task(task)
    return Result(
        poses.stem,
        len(drive.truth.frames),
        len(drive.slam.nodes),
        drive.path_m,
        drive.ate_m(drive.slam),
        off,
        outcomes,
        clock.seconds,
    )


def with_decision(config: Config, robust: bool) -> Config:
    """Switch the pose graph's doubt of closures on or off."""
    graph = config.pose_graph.model_copy(update={"robust": robust})
    return config.model_copy(update={"pose_graph": graph})


def error_rows(results: Sequence[Result], shares: Sequence[float]) -> list[list[str]]:
    """Return the table of ATE: header, sequences, means."""
    ours = ["chained", *(f"{_case(case)}" for case in _cases(shares))]
    header = ["seq", "km", "windows", "revisits", *ours, *PUBLISHED]
    columns = [
        [result.chained_m, *(result.outcomes[case].ate_m for case in _cases(shares))]
        + [_published(row, result.name) for row in PUBLISHED.values()]
        for result in results
    ]
    rows = [
        [result.name, f"{result.path_m / 1e3:.2f}", str(result.windows), str(len(result.off))]
        + [_number(value) for value in values]
        for result, values in zip(results, columns, strict=True)
    ]
    for name, chosen in (
        ("mean", [True] * len(results)),
        (f"mean w/o {HIGHWAY}", [result.name != HIGHWAY for result in results]),
    ):
        if any(chosen):
            means = np.mean(np.array(columns)[chosen], axis=0)
            rows.append([name, "", "", "", *(_number(value) for value in means)])
    return [header, *rows]


def closure_rows(results: Sequence[Result], shares: Sequence[float]) -> list[list[str]]:
    """Return the table of closures and time: what is off, what is kept, what it took."""
    robust = [case for case in _cases(shares) if case[1]]
    header = ["seq", "frames", "off ° / m", "misfit σ"]
    header += [f"{_case(case)}: right, wrong kept" for case in robust]
    header += ["city s", "predict s", "chain s", "loop windows s", "optimise s"]
    rows = []
    for result in results:
        off = np.median(result.off, axis=0) if len(result.off) else [np.nan, np.nan]
        first = result.outcomes[robust[0]]
        row = [result.name, str(result.frames), f"{off[0]:.2f} / {off[1]:.2f}"]
        row.append(_number(first.misfit))
        for case in robust:
            kept, given = result.outcomes[case].kept, result.outcomes[case].given
            row.append(f"{kept[0]}/{given[0]}, {kept[1]}/{given[1]}")
        row += [f"{result.seconds[key]:.1f}" for key in ("city", "predict", "register", "measure")]
        rows.append([*row, " ".join(f"{result.outcomes[case].seconds:.1f}" for case in robust)])
    return [header, *rows]


def _cases(shares: Sequence[float]) -> list[Case]:
    return [(share, robust) for robust in (True, False) for share in shares]


def _case(case: Case) -> str:
    share, robust = case
    return f"{'' if robust else 'plain, '}{share:.0%} wrong"


def _published(errors: Sequence[float], name: str) -> float:
    return errors[SEQUENCES.index(name)] if name in SEQUENCES else float("nan")


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}" if value < 1000 else f"{value:.0f}"


def print_table(rows: Sequence[Sequence[str]], title: str, *, markdown: bool) -> None:
    """Print a header and rows, as Markdown or in columns."""
    header, *body = rows
    if markdown:
        lines = [header, ["---"] * len(header), *body]
        print(f"{title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n")
        return
    table = Table(*header, title=title)
    for row in body:
        table.add_row(*row)
    Console(width=None if Console().is_terminal else 220).print(table)


def main(  # noqa: PLR0913, PLR0917  (the options of a command)
    folder: Annotated[Path, typer.Argument(help="folder of trajectories in KITTI's format")],
    only: Annotated[str, typer.Option(help="such as 00,05; none: all")] = "",
    wrong: Annotated[str, typer.Option(help="shares of wrong closures")] = "0,0.1,0.3",
    group: Annotated[int, typer.Option(min=1, help="wrong ones in a row that agree")] = 1,
    near: Annotated[float, typer.Option(help="metres between the cameras of a revisit")] = 4.0,
    angle: Annotated[float, typer.Option(help="degrees between their axes")] = 30.0,
    apart: Annotated[float, typer.Option(help="metres from one pair to the next")] = 25.0,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", help="setting, such as windows.size=60")
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="print Markdown")] = False,
) -> None:
    """Print errors of trajectories and closures with and without loops, right and wrong."""
    try:
        config = load_config(assignments=[*SETTINGS, *(assignments or [])])
        shares = tuple(float(share) for share in wrong.split(","))
        plan = Plan(shares, group, RevisitRule(near, angle, apart_m=apart))
        files = [folder / f"{name}.txt" for name in only.split(",") if name]
        with Progress(console=Console(stderr=True)) as progress:
            files = files or sorted(folder.glob("*.txt"))
            chosen = progress.track(files, description="sequences")
            results = [simulate(poses, config, plan, progress) for poses in chosen]
    except LaserSlamError as error:
        typer.echo(f"simulate_loops: {error}", err=True)
        raise typer.Exit(1) from error
    print_table(error_rows(results, shares), "ATE, m", markdown=markdown)
    print_table(closure_rows(results, shares), "Closures; CPU seconds", markdown=markdown)


if __name__ == "__main__":
    typer.run(main)
