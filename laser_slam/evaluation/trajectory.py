"""Errors of a trajectory against the truth: absolute, relative, and KITTI's.

The truth may cover only some of the frames; only frames that both have are compared. A score that
the data do not determine is None, never 0.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Sim3, rotation_log, umeyama
from laser_slam.types import Trajectory

Array = NDArray[np.float64]

KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
KITTI_STEP = 10  # frames between the starts of KITTI's segments
_MIN_SPREAD_M = 1e-3  # a truth that stays within a millimetre determines nothing


def _no_errors() -> Array:
    return np.empty(0)


@dataclass(frozen=True)
class Statistics:
    """Errors of many frames in four numbers, in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: Array) -> Statistics | None:
        """Summarise (N,) errors; None when there are none."""
        if len(errors) == 0:
            return None
        return cls(
            float(np.sqrt(np.mean(errors**2))),
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.max(errors)),
        )


@dataclass(frozen=True)
class KittiErrors:
    """KITTI's odometry scores: the mean over all segments of 100, 200, ... 800 m.

    Attributes:
        t_rel_percent: translation error per length of the segment; None: no segment fits.
        r_rel_deg_per_100m: rotation error per length of the segment; None: no segment fits.
        num_segments: how many segments the means are over.
    """

    t_rel_percent: float | None
    r_rel_deg_per_100m: float | None
    num_segments: int


@dataclass(frozen=True)
class TrajectoryErrors:
    """Everything that the truth says of a trajectory; None where it says nothing.

    Attributes:
        frames: (N,) indices of the frames that estimate and truth have in common.
        distances_m: (N,) path of the truth up to each of them.
        num_frames: how many these are.
        num_truth: frames whose true pose is known, whether they were estimated or not.
        path_length_m: of the truth over these frames.
        scale: metres per world unit of the Sim(3) alignment.
        ate_sim3_m: absolute errors after the best similarity.
        ate_se3_m: absolute errors after the best rigid motion; the estimate keeps its own scale.
        rpe_translation_m: relative errors over one frame, of the estimate scaled by ``scale``.
        rpe_rotation_deg: their rotations.
        kitti: KITTI's scores of the estimate scaled by ``scale``.
        kitti_unscaled: KITTI's scores of the estimate as it is; fair only where it is metric.
        errors_m: (N,) absolute errors after the Sim(3) alignment; empty without one.
        drift_m: (N,) distance from the truth when the first poses coincide and ``scale`` is
            applied: how far the map has slid since its start; empty without an alignment.
        reason: why nothing is scored; None: all is, but what is too short for KITTI's lengths.
    """

    frames: NDArray[np.int64]
    distances_m: Array
    num_frames: int
    path_length_m: float
    scale: float | None = None
    ate_sim3_m: Statistics | None = None
    ate_se3_m: Statistics | None = None
    rpe_translation_m: Statistics | None = None
    rpe_rotation_deg: Statistics | None = None
    kitti: KittiErrors = KittiErrors(None, None, 0)
    kitti_unscaled: KittiErrors = KittiErrors(None, None, 0)
    errors_m: Array = field(default_factory=_no_errors)
    drift_m: Array = field(default_factory=_no_errors)
    reason: str | None = None
    num_truth: int = 0

    def numbers(self) -> dict[str, object]:
        """Return the scores without the series, ready for JSON."""
        series = {"frames", "distances_m", "errors_m", "drift_m"}
        return {key: value for key, value in asdict(self).items() if key not in series}


def evaluate_trajectory(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Compare an estimate with the truth by every measure; what cannot be had is None.

    Args:
        estimate: in world units, of any scale.
        truth: in metres, of all frames or some.
    """
    num_truth = len(truth.frames)
    estimate, truth = common_frames(estimate, truth)
    distances, num = path_distances(truth), len(truth.frames)
    unscored = TrajectoryErrors(
        truth.frames, distances, num, float(distances.max(initial=0)), num_truth=num_truth
    )
    try:
        sim3 = align(estimate, truth, with_scale=True)
        se3 = align(estimate, truth, with_scale=False)
    except DegenerateGeometryError as error:
        return replace(unscored, reason=str(error))
    errors = absolute_errors(estimate, truth, sim3)
    moves, turns = relative_errors(estimate, truth, sim3.scale)
    return replace(
        unscored,
        scale=sim3.scale,
        ate_sim3_m=Statistics.of(errors),
        ate_se3_m=Statistics.of(absolute_errors(estimate, truth, se3)),
        rpe_translation_m=Statistics.of(moves),
        rpe_rotation_deg=Statistics.of(np.degrees(turns)),
        kitti=kitti_errors(estimate, truth, sim3.scale),
        kitti_unscaled=kitti_errors(estimate, truth),
        errors_m=errors,
        drift_m=drift_from_start(estimate, truth, sim3.scale),
    )


def common_frames(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return both trajectories at the frames that both have."""
    _, in_estimate, in_truth = np.intersect1d(estimate.frames, truth.frames, return_indices=True)
    return _at(estimate, in_estimate), _at(truth, in_truth)


def _at(trajectory: Trajectory, chosen: NDArray[np.intp]) -> Trajectory:
    return Trajectory(
        trajectory.frames[chosen], trajectory.times_s[chosen], trajectory.world_from_cam[chosen]
    )


def align(estimate: Trajectory, truth: Trajectory, with_scale: bool) -> Sim3:
    """Find the motion that brings the estimated camera centres nearest to the true ones.

    Args:
        estimate: in world units.
        truth: in metres, of all frames or some.
        with_scale: True fits a similarity, False a rigid motion.

    Returns:
        ``truth_from_estimate``.

    Raises:
        DegenerateGeometryError: fewer than 3 common frames, or one of the paths is a point.
    """
    estimate, truth = common_frames(estimate, truth)
    if len(truth.frames) < 3:
        raise DegenerateGeometryError(
            f"estimate and truth have {len(truth.frames)} frames in common, need 3"
        )
    centers = truth.world_from_cam[:, :3, 3]
    if np.linalg.norm(centers - centers.mean(axis=0), axis=1).max() < _MIN_SPREAD_M:
        raise DegenerateGeometryError("the true path stays in one place, nothing can be scored")
    found = estimate.world_from_cam[:, :3, 3]
    if np.ptp(found, axis=0).max() <= 1e-9 * max(float(np.abs(found).max()), 1e-300):
        raise DegenerateGeometryError("the estimated path stays in one place, the true one moves")
    return umeyama(found, centers, with_scale=with_scale)


def absolute_errors(estimate: Trajectory, truth: Trajectory, truth_from_estimate: Sim3) -> Array:
    """Return the (N,) distances in metres of the aligned centres from the true ones."""
    estimate, truth = common_frames(estimate, truth)
    placed = truth_from_estimate.apply(estimate.world_from_cam[:, :3, 3])
    return np.asarray(np.linalg.norm(placed - truth.world_from_cam[:, :3, 3], axis=1))


def relative_errors(
    estimate: Trajectory, truth: Trajectory, scale: float = 1.0, delta: int = 1
) -> tuple[Array, Array]:
    """Compare the motions over ``delta`` frames, from every frame that has such a partner.

    Args:
        estimate: in world units; where it lies does not matter.
        truth: in metres, of all frames or some.
        scale: metres per world unit.
        delta: difference of the frame indices, >= 1.

    Returns:
        (M,) translation errors in metres and (M,) rotation errors in radians.
    """
    estimate, truth = common_frames(estimate, truth)
    _, start, end = np.intersect1d(truth.frames + delta, truth.frames, return_indices=True)
    return _motion_errors(_rescaled(estimate, scale), truth.world_from_cam, start, end)


def kitti_errors(estimate: Trajectory, truth: Trajectory, scale: float = 1.0) -> KittiErrors:
    """Score as KITTI's odometry benchmark: segments of 100 to 800 m from every 10th frame.

    Args:
        estimate: in world units.
        truth: in metres, of all frames or some.
        scale: metres per world unit. KITTI itself scores metric estimates; for monocular ones the
            scale of the Sim(3) alignment is usual, and must be said.
    """
    estimate, truth = common_frames(estimate, truth)
    distances = path_distances(truth)
    first = np.arange(0, len(distances), KITTI_STEP)
    start, length = (part.ravel() for part in np.meshgrid(first, KITTI_LENGTHS_M, indexing="ij"))
    end = np.searchsorted(distances, distances[start] + length, side="right")
    fits = end < len(distances)
    start, end, length = start[fits], end[fits], length[fits]
    if len(start) == 0:
        return KittiErrors(None, None, 0)
    moves, turns = _motion_errors(_rescaled(estimate, scale), truth.world_from_cam, start, end)
    return KittiErrors(
        t_rel_percent=float(np.mean(moves / length) * 100),
        r_rel_deg_per_100m=float(np.mean(np.degrees(turns) / length) * 100),
        num_segments=len(start),
    )


def drift_from_start(estimate: Trajectory, truth: Trajectory, scale: float) -> Array:
    """Return the (N,) distances in metres from the truth when the first poses coincide."""
    estimate, truth = common_frames(estimate, truth)
    poses = _rescaled(estimate, scale)
    truth_from_estimate = truth.world_from_cam[0] @ np.linalg.inv(poses[0])
    return np.asarray(
        np.linalg.norm((truth_from_estimate @ poses - truth.world_from_cam)[:, :3, 3], axis=1)
    )


def path_distances(trajectory: Trajectory) -> Array:
    """Return the (N,) lengths of the path up to each pose, in the trajectory's unit."""
    steps = np.linalg.norm(np.diff(trajectory.world_from_cam[:, :3, 3], axis=0), axis=1)
    return np.concatenate([np.zeros(min(len(trajectory.frames), 1)), np.cumsum(steps)])


def _rescaled(trajectory: Trajectory, scale: float) -> Array:
    poses = np.array(trajectory.world_from_cam)
    poses[:, :3, 3] *= scale
    return poses


def _motion_errors(
    found: Array, true: Array, start: NDArray[np.intp], end: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return how far (metres) and how much (radians) motions of (N, 4, 4) poses differ."""
    found_motion = np.linalg.inv(found[start]) @ found[end]
    true_motion = np.linalg.inv(true[start]) @ true[end]
    error = np.linalg.inv(true_motion) @ found_motion
    turns = rotation_log(error[:, :3, :3]) if len(error) else np.empty((0, 3))
    return np.linalg.norm(error[:, :3, 3], axis=1), np.linalg.norm(turns, axis=1)
