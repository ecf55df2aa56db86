"""The path of a laser scanner by its scans alone (KISS-ICP)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.dependencies import import_kiss_icp, num_threads

Array = NDArray[np.float64]


def track_scans(scans: Iterable[tuple[Array, Array]]) -> Iterator[Array]:
    """Register each scan with the map of those before, with KISS-ICP's own defaults.

    Args:
        scans: (N, 3) points in metres, in the scanner's axes, and (N,) when in the scanner's turn
            each was seen; empty: the motion during the turn is taken out already.

    Yields:
        ``first_from_scanner`` (4, 4) rigid of each scan, metres; the first is the identity. Where
        scans have times, it holds at the end of the turn.

    Raises:
        DependencyError: KISS-ICP is not installed.

    Reference: Vizzo et al., KISS-ICP, RA-L 2023. Differs: in nothing; the loop is that of its
    ``OdometryPipeline``, which would also write files, print, and want the truth of sequences
    that have one.
    """
    odometry = _make_odometry()
    for points, times in scans:
        odometry.register_frame(points, times)
        yield np.array(odometry.last_pose)


def _make_odometry() -> Any:
    kiss_icp = import_kiss_icp()
    config = kiss_icp.config.load_config(None)
    config.registration.max_num_threads = num_threads()
    return kiss_icp.kiss_icp.KissICP(config)
