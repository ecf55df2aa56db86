"""Rows of a table: the scores of one sequence or why it has none, and means that say over how many.

A sequence that failed stays a row; it counts for no mean, and every mean names what it lacks.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from laser_slam.evaluation.points import PointErrors
from laser_slam.evaluation.trajectory import Statistics, TrajectoryErrors
from laser_slam.evaluation.video_depth import VideoDepthErrors

KITTI_ODOMETRY = tuple(f"{sequence:02d}" for sequence in range(11))
KITTI_HIGHWAY = "01"  # the paper's Avg.* leaves it out


@dataclass(frozen=True)
class SequenceScores:
    """The scores of one sequence, or why it has none.

    Attributes:
        name: of the sequence.
        scores: by name, with the unit in it; None: the data do not determine it.
        weight: in a weighted mean, such as the number of compared pixels.
        coverage: share of the truth that the scores are over, in [0, 1]; None: unknown.
        reason: why there are no scores; None: there are.
    """

    name: str
    scores: Mapping[str, float | None]
    weight: float = 1.0
    coverage: float | None = None
    reason: str | None = None


@dataclass(frozen=True)
class Mean:
    """A mean over sequences, and over which.

    Attributes:
        value: None: no sequence has the score.
        num: how many sequences it is over.
        missing: the sequences that should be in it and have no such score.
    """

    value: float | None
    num: int
    missing: tuple[str, ...]

    @property
    def num_sequences(self) -> int:
        """Say how many sequences should be in it."""
        return self.num + len(self.missing)


def failed_sequence(name: str, reason: str) -> SequenceScores:
    """Make the row of a sequence that could not be run or scored."""
    return SequenceScores(name, {}, coverage=0.0, reason=reason)


def pose_scores(name: str, errors: TrajectoryErrors) -> SequenceScores:
    """Make the row of a camera-pose table: root mean squares after Sim(3) alignment.

    Its scores are ``ate_m``, and over one frame ``rpe_trans_m`` and ``rpe_rot_deg``.
    """
    scores = {
        "ate_m": _rmse(errors.ate_sim3_m),
        "rpe_trans_m": _rmse(errors.rpe_translation_m),
        "rpe_rot_deg": _rmse(errors.rpe_rotation_deg),
    }
    return SequenceScores(name, scores, 1.0, _share_of_poses(errors), errors.reason)


def kitti_scores(name: str, errors: TrajectoryErrors) -> SequenceScores:
    """Make the row of KITTI odometry: ``ate_m``, ``t_rel_percent`` and ``r_rel_deg_per_100m``.

    All of the estimate scaled as the Sim(3) alignment scales it.
    """
    scores = {
        "ate_m": _rmse(errors.ate_sim3_m),
        "t_rel_percent": errors.kitti.t_rel_percent,
        "r_rel_deg_per_100m": errors.kitti.r_rel_deg_per_100m,
    }
    return SequenceScores(name, scores, 1.0, _share_of_poses(errors), errors.reason)


def video_depth_scores(name: str, errors: VideoDepthErrors) -> SequenceScores:
    """Make the row of a video-depth table: ``abs_rel`` and ``delta_125``, weighted by pixels."""
    scores = {"abs_rel": errors.abs_rel, "delta_125": errors.delta_125}
    return SequenceScores(name, scores, errors.num_pixels, errors.coverage, errors.reason)


def point_scores(name: str, errors: PointErrors) -> SequenceScores:
    """Make the row of a point-map table, with all that ``PointErrors`` has in metres and NC."""
    names = ("acc_mean_m", "acc_median_m", "comp_mean_m", "comp_median_m", "chamfer_m")
    scores = {key: getattr(errors, key) for key in (*names, "nc_mean", "nc_median")}
    coverage = errors.num_points / errors.num_truth if errors.num_truth else None
    return SequenceScores(name, scores, 1.0, coverage, errors.reason)


def mean_score(
    rows: Sequence[SequenceScores],
    score: str,
    *,
    without: Collection[str] = (),
    is_weighted: bool = False,
) -> Mean:
    """Average one score over the sequences that have it.

    Args:
        rows: all sequences of the table, the failed ones too.
        score: its name.
        without: sequences that are left out on purpose.
        is_weighted: True weights each sequence, as video depth does with its pixels.

    >>> rows = [SequenceScores("00", {"ate_m": 6.0}), failed_sequence("01", "tracking lost")]
    >>> mean_score(rows, "ate_m")
    Mean(value=6.0, num=1, missing=('01',))
    """
    asked = [row for row in rows if row.name not in without]
    found = [(row, value) for row in asked if (value := row.scores.get(score)) is not None]
    missing = tuple(row.name for row in asked if row.scores.get(score) is None)
    total = sum(row.weight if is_weighted else 1.0 for row, _ in found)
    if not total:
        return Mean(None, 0, tuple(row.name for row in asked))
    value = sum(value * (row.weight if is_weighted else 1.0) for row, value in found) / total
    return Mean(value, len(found), missing)


def kitti_means(rows: Sequence[SequenceScores], score: str = "ate_m") -> tuple[Mean, Mean]:
    """Average over KITTI odometry as the paper's table does.

    Args:
        rows: sequences by their official names; those of 00 to 10 that are not there are missing.
        score: its name.

    Returns:
        ``Avg.`` over all and ``Avg.*`` without 01.
    """
    names = {row.name for row in rows}
    absent = [failed_sequence(name, "not run") for name in KITTI_ODOMETRY if name not in names]
    every = sorted([*rows, *absent], key=lambda row: row.name)
    return mean_score(every, score), mean_score(every, score, without=(KITTI_HIGHWAY,))


def _rmse(errors: Statistics | None) -> float | None:
    return None if errors is None else errors.rmse


def _share_of_poses(errors: TrajectoryErrors) -> float | None:
    return errors.num_frames / errors.num_truth if errors.num_truth else None
