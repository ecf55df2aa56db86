"""Hold the closures of a finished run against its truth.

python tools/judge_closures.py runs/latest
python tools/judge_closures.py runs/latest --near 4 --angle 30 --gap 60

A candidate is right if its two frames are within --near metres and --angle degrees of each other
in truth, wrong if they are three times --near or the angle apart; what lies between counts as
neither. A stretch is a run of frames that all come by within --near and --angle of a frame that
lies --gap metres or more of way behind them; it is found if a closure ends on it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from laser_slam.closures import ClosureRecord, read_closures
from laser_slam.errors import LaserSlamError
from laser_slam.rescoring import read_trajectory

Array = NDArray[np.float64]


class Rule(NamedTuple):
    """What a revisit is: metres, degrees, metres of way between."""

    near_m: float
    angle_deg: float
    gap_m: float


def main(
    run: Annotated[Path, typer.Argument(help="folder of a finished run with truth")],
    near: Annotated[float, typer.Option(help="metres between right pairs")] = 4.0,
    angle: Annotated[float, typer.Option(help="degrees between right pairs")] = 30.0,
    gap: Annotated[float, typer.Option(help="metres of way between two visits")] = 60.0,
) -> None:
    """Print how many candidates and closures are right, and how many revisits were found."""
    try:
        records = read_closures(run / "closures.json")
        truth = read_trajectory(run / "truth_tum.txt", None).world_from_cam
        report = json.loads((run / "report.json").read_text(encoding="utf-8"))
    except (LaserSlamError, OSError, ValueError) as error:
        typer.echo(f"judge_closures: {error}", err=True)
        raise typer.Exit(1) from error
    rule = Rule(near, angle, gap)
    table = Table("", "right", "between", "wrong")
    for name, chosen in (
        ("candidates", records),
        ("closed", [r for r in records if r.is_accepted]),
    ):
        kinds = [_kind(truth, record, rule) for record in chosen]
        table.add_row(name, *(str(kinds.count(kind)) for kind in ("right", "between", "wrong")))
    Console().print(table)
    stretches = revisits(truth, rule)
    ends = [max(r.frame_a, r.frame_b) for r in records if r.is_accepted]
    found = sum(any(first <= end <= last for end in ends) for first, last in stretches)
    typer.echo(f"{found} of {len(stretches)} stretches that are driven again are closed")
    typer.echo(f"ATE {_ate(report['trajectory'])}, without closures {_without(report)}")
    typer.echo(f"CPU: {_seconds(report)}")


def revisits(world_from_cam: Array, rule: Rule) -> list[tuple[int, int]]:
    """Return the first and last frame of each stretch that is driven again.

    Args:
        world_from_cam: (N, 4, 4) the truth, metres.
        rule: what a revisit is.
    """
    centers, axes = world_from_cam[:, :3, 3], world_from_cam[:, :3, 2]
    steps = np.linalg.norm(np.diff(centers, axis=0, prepend=centers[:1]), axis=1)
    way = np.cumsum(steps)
    least = np.cos(np.radians(rule.angle_deg))
    is_again = np.zeros(len(centers), dtype=bool)
    for frame, near in enumerate(cKDTree(centers).query_ball_point(centers, rule.near_m)):
        earlier = np.array([i for i in near if way[frame] - way[i] >= rule.gap_m], dtype=np.int64)
        is_again[frame] = len(earlier) > 0 and bool((axes[earlier] @ axes[frame] >= least).any())
    edges = np.diff(np.concatenate([[0], is_again.astype(np.int8), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def _kind(world_from_cam: Array, record: ClosureRecord, rule: Rule) -> str:
    a, b = world_from_cam[record.frame_a], world_from_cam[record.frame_b]
    apart_m = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    turn_deg = float(np.degrees(np.arccos(np.clip(a[:3, 2] @ b[:3, 2], -1, 1))))
    if apart_m <= rule.near_m and turn_deg <= rule.angle_deg:
        return "right"
    return "wrong" if apart_m > 3 * rule.near_m or turn_deg > 3 * rule.angle_deg else "between"


def _ate(errors: dict[str, Any] | None) -> str:
    if not errors or not errors.get("ate_sim3_m"):
        return "unknown"
    return f"{errors['ate_sim3_m']['rmse']:.3f} m"


def _without(report: dict[str, Any]) -> str:
    closures = report["closures"]
    return _ate(closures["trajectory_without"]) if closures else "unknown"


def _seconds(report: dict[str, Any]) -> str:
    cpu = report["seconds"]["cpu"]
    return ", ".join(f"{name} {cpu[name]:.1f} s" for name in ("places", "optimise") if name in cpu)


if __name__ == "__main__":
    typer.run(main)
