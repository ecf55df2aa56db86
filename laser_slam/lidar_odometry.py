"""The path of a laser scanner by its scans alone (KISS-ICP)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.dependencies import import_kiss_icp, num_threads
from laser_slam.sim3 import Sim3, interpolate_sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Turn:
    """What a scanner saw in one turn.

    Attributes:
        frame: which turn this is; turns without a scan are counted too.
        points: (N, 3) in metres, in the scanner's axes.
        shares: (N,) when in the turn each point was seen, 0 to 1; None: the motion during the
            turn is taken out already.
    """

    frame: int
    points: Array
    shares: Array | None = None


def track_scans(turns: Iterable[Turn]) -> Iterator[Array]:
    """Register each scan with the map of those before, with KISS-ICP's own defaults.

    Args:
        turns: frames rise.

    Yields:
        ``first_from_scanner`` (4, 4) rigid of each scan in the middle of its turn, metres; the
        first is the identity.

    Raises:
        DependencyError: KISS-ICP is not installed.

    Reference: Vizzo et al., KISS-ICP, RA-L 2023. Differs: a turn is straightened to its middle,
        when images are taken, instead of its end; and where turns lack scans, as some of KITTI's
        do, the motion that it foresees, and takes out of a turn, is that of as many turns as
        there were. Else the loop is that of its ``OdometryPipeline``, which would also write
        files, print, and want the truth of sequences that have one.
    """
    odometry = _make_odometry()
    gap_before, frame_before = 1, None
    for turn in turns:
        gap = gap_before if frame_before is None else turn.frame - frame_before
        points = turn.points
        if turn.shares is not None:
            motion = _share(odometry.last_delta, 1 / gap_before)
            points = _straighten(odometry, points, turn.shares, motion)
        odometry.last_delta = _share(odometry.last_delta, gap / gap_before)
        odometry.register_frame(points, np.empty(0))
        yield np.array(odometry.last_pose)
        gap_before, frame_before = gap, turn.frame


def _straighten(odometry: Any, points: Array, shares: Array, motion: Array) -> Array:
    """Return where the points were in the middle of a turn during which the scanner moved."""
    at_end = odometry.preprocessor.preprocess(points, shares, motion)
    middle_from_end = _share(motion, 0.5)
    return np.asarray(at_end @ middle_from_end[:3, :3].T + middle_from_end[:3, 3])


def _share(motion: Array, share: float) -> Array:
    """Go a share of a rigid (4, 4) motion, or some of it on top, at a constant rate."""
    if share == 1:
        return motion
    return interpolate_sim3(Sim3(), Sim3.from_matrix(motion), np.array([share]))[0].matrix()


def _make_odometry() -> Any:
    kiss_icp = import_kiss_icp()
    config = kiss_icp.config.load_config(None)
    config.registration.max_num_threads = num_threads()
    return kiss_icp.kiss_icp.KissICP(config)
