"""A measured similarity between the ends of a candidate, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from laser_slam.sim3 import Array, Sim3, cross_matrix, rotation_exp, rotation_log


@dataclass(frozen=True)
class Measurement:
    """The similarity between the windows of two ends.

    Attributes:
        a_from_b: maps points of window b to window a.
        covariance: (7, 7) of its error: rotation (radians) and translation, of window b's origin,
            in a's axes and units; log-scale.
        inliers: matches, or pixels, that it rests on.
        total: of how many.
        residual: median absolute log-ratio of the depths after alignment.
        source: what measured it, in a word.
    """

    a_from_b: Sim3
    covariance: Array
    inliers: int
    total: int
    residual: float
    source: str

    @property
    def sigmas(self) -> Array:
        """Return (7,) as in ``Registration.sigmas``, a being the previous window."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


def error_between(measured: Sim3, true: Sim3) -> Array:
    """Return (7,) how far a similarity is off: rotation, translation, log-scale in its axes."""
    turn = rotation_log(measured.rotation @ true.rotation.T)
    move = measured.translation - true.translation
    return np.concatenate([turn, move, [np.log(measured.scale / true.scale)]])


def disagreement(first: Measurement, second: Measurement) -> float:
    """Return how far two measurements of one closure are apart, in sigmas: 2 to 4 is usual."""
    error = error_between(first.a_from_b, second.a_from_b)
    return float(np.sqrt(error @ np.linalg.solve(first.covariance + second.covariance, error)))


def fuse(first: Measurement, second: Measurement) -> Measurement:
    """Return the mean of two measurements of one closure, each weighing what it is sure of.

    Both rest on the same depths, so that two do not make it surer than the surer one: half of the
    information of each (covariance intersection).

    Returns:
        The mean, with the residual of the worse and the counts of the first.
    """
    gain = first.covariance @ np.linalg.inv(first.covariance + second.covariance)
    step = gain @ error_between(second.a_from_b, first.a_from_b)
    start = first.a_from_b
    mean = Sim3(
        start.scale * float(np.exp(step[6])),
        rotation_exp(step[:3]) @ start.rotation,
        start.translation + step[3:6],
    )
    covariance = 2 * (first.covariance - gain @ first.covariance)
    return replace(
        first,
        a_from_b=mean,
        covariance=(covariance + covariance.T) / 2,
        residual=max(first.residual, second.residual),
        source=f"{first.source}, {second.source}",
    )


def moved_by(point: Array, pivot: Array) -> Array:
    """Return (7, 7) how an error at a pivot looks at a point that turns and grows about it.

    Args:
        point: (3,) whose translation is wanted, such as window b's origin, in a's axes.
        pivot: (3,) whose translation is known, in a's axes.
    """
    arm = point - pivot
    out = np.eye(7)
    out[3:6, :3] = -cross_matrix(arm)  # w x arm
    out[3:6, 6] = arm
    return out
