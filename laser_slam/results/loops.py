"""What became of the loops of a run, and what it would be without them."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.closures import ClosureRecord, write_closures
from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation.trajectory import TrajectoryErrors, evaluate_trajectory
from laser_slam.export import write_tum
from laser_slam.places.similarity import SimilarityMap
from laser_slam.pose_graph import write_g2o
from laser_slam.slam import LoopCloser, Slam
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

CHAINED_FILE = "trajectory_without_loops_tum.txt"
NUM_SIGMAS = 20  # windows of which the report says how sure they are

logger = logging.getLogger(__name__)

_NUMBER = re.compile(r"\d+(\.\d+)?(e[+-]?\d+)?")


@dataclass(frozen=True)
class Loops:
    """What became of the loops of a run.

    Attributes:
        records: of all candidates.
        num_distrusted: closures that passed all checks and were left out by the pose graph.
        similarities: of all keyframes.
        chained: a pose for every frame, by the registrations alone.
        truth: poses in metres; None: there is none.
        errors: of ``chained``; None: there is no truth.
        sigmas: (7,) of the places of some windows, by index, as ``PoseGraph`` gives them.
    """

    records: Sequence[ClosureRecord]
    num_distrusted: int
    similarities: SimilarityMap
    chained: Trajectory
    truth: Trajectory | None
    errors: TrajectoryErrors | None
    sigmas: dict[int, Array]


def look_back(
    closer: LoopCloser, slam: Slam, chained: Trajectory, truth: Trajectory | None
) -> Loops:
    """Gather what is known of the loops at the end of a run.

    Args:
        closer: that closed them.
        slam: whose windows they moved.
        chained: a pose for every frame, by the registrations alone.
        truth: poses in metres; None: there is none.
    """
    return Loops(
        closer.records,
        closer.num_distrusted,
        closer.similarity_map(),
        chained,
        truth,
        None if truth is None else evaluate_trajectory(chained, truth),
        _sigmas(slam),
    )


def _sigmas(slam: Slam) -> dict[int, Array]:
    """Return how sure the places of some windows are; none, with a warning, where it is unknown."""
    last = len(slam.nodes) - 1
    some = np.unique(np.linspace(0, last, NUM_SIGMAS).round().astype(int)).tolist()
    try:
        return slam.pose_graph().marginal_sigmas(some)
    except DegenerateGeometryError as error:
        logger.warning("how sure the windows' places are is unknown: %s", error)
        return {}


def write_loops(folder: Path, loops: Loops, slam: Slam) -> None:
    """Write the records of all candidates, the pose graph (g2o), and the path without loops (TUM).

    Raises:
        RunFolderError: a file cannot be written.
    """
    write_closures(folder / "closures.json", loops.records)
    write_g2o(folder / "graph.g2o", slam.pose_graph())
    write_tum(folder / CHAINED_FILE, loops.chained)


def describe_loops(loops: Loops | None) -> dict[str, Any] | None:
    """Sum up the loops for the report; None: they were not looked for."""
    if loops is None:
        return None
    refused = [_reason(record) for record in loops.records if not record.is_accepted]
    return {
        "candidates": len(loops.records),
        "accepted": len(loops.records) - len(refused),
        "distrusted": loops.num_distrusted,
        "refused": dict(Counter(refused).most_common()),
        "trajectory_without": loops.errors.numbers() if loops.errors else None,
        "sigmas": {str(i): _in_words(sigmas) for i, sigmas in loops.sigmas.items()} or None,
        "records": [asdict(record) for record in loops.records],
    }


def _in_words(sigmas: Array) -> dict[str, Any]:
    """Name the (7,) sigmas of a place in the world's axes and units."""
    return {
        "rotation_deg": np.degrees(sigmas[:3]),
        "translation": sigmas[3:6],
        "scale_percent": 100 * float(sigmas[6]),
    }


def _reason(record: ClosureRecord) -> str:
    """Return a verdict without its numbers and details, so that equal ones can be counted."""
    return _NUMBER.sub("N", record.verdict.partition(":")[0])
