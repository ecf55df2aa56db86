"""A candidate measured and judged: accepted, or the reason against it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from laser_slam.backbones.base import Backbone
from laser_slam.closures.alignment import align_clouds, displacement
from laser_slam.closures.clouds import Comparison, EndCloud, compare, make_cloud
from laser_slam.closures.ends import End, Matcher, match_ends
from laser_slam.closures.loop_window import measure_by_window
from laser_slam.closures.matches import measure_by_matches
from laser_slam.closures.measurement import Measurement, disagreement, fuse
from laser_slam.closures.records import ACCEPTED, ClosureRecord
from laser_slam.config import ClosuresConfig, Config
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array, Sim3
from laser_slam.types import WindowStatus

_SURE = 3.0  # sigmas of the chain's scale that it may be off


@dataclass(frozen=True)
class CandidateEnds:
    """A candidate with what is needed to measure it.

    Attributes:
        a: one end.
        b: the other.
        similarity: of the two frames' descriptors.
        chain_scale: units of a per unit of b, as the chain of registrations has it.
        guess_sigma: of its logarithm, from windows whose place was only guessed.
    """

    a: End
    b: End
    similarity: float
    chain_scale: float
    guess_sigma: float = 0.0


@dataclass(frozen=True)
class Tools:
    """What candidates are measured with.

    Attributes:
        matcher: of two images; see ``make_matcher``.
        backbone: for windows of both ends, if it ``sees_far_frames``; None: matches must do.
    """

    matcher: Matcher
    backbone: Backbone | None = None


@dataclass(frozen=True)
class Judged:
    """What became of a candidate.

    Attributes:
        record: for ``closures.json``.
        measurement: of the closure; None: it was rejected.
    """

    record: ClosureRecord
    measurement: Measurement | None


def judge(candidate: CandidateEnds, tools: Tools, config: Config) -> Judged:
    """Measure a candidate and decide whether it is a closure; bad geometry is a verdict.

    The images must match, matches and depths must fit one similarity, the backbone's window of
    both ends, where there is one, must agree with it, scale and heading must be credible, and the
    clouds must lie on one another where both ends could see.
    """
    a, b = candidate.a, candidate.b
    numbers: dict[str, Any] = {"chain_scale": candidate.chain_scale}
    measurement, verdict = None, ACCEPTED
    try:
        measurement = _measure(candidate, tools, config, numbers)
        _check_similarity(candidate, measurement, config.closures, numbers)
        measurement = _check_clouds(a, b, measurement, config.closures, numbers)
    except DegenerateGeometryError as error:
        measurement, verdict = None, str(error)
    record = ClosureRecord(
        a.window, b.window, a.frame, b.frame, float(candidate.similarity), verdict, **numbers
    )
    return Judged(record, measurement)


def _measure(
    candidate: CandidateEnds, tools: Tools, config: Config, numbers: dict[str, Any]
) -> Measurement:
    """Measure by matches, and through the backbone's window if there is one."""
    a, b = candidate.a, candidate.b
    for end in (a, b):
        if end.prediction.status is not WindowStatus.OK or not np.isfinite(end.median_depth):
            raise DegenerateGeometryError(f"window {end.window} has no depth")
    images, pairs = match_ends(a, b, tools.matcher, config.closures)
    numbers.update(image_inliers=images.num_inliers, image_pairs=len(pairs))
    if images.rejected:
        raise DegenerateGeometryError(f"the images do not match: {images.rejected}")
    found = measure_by_matches(a, b, pairs, config.closures)
    _note(found, numbers)
    if tools.backbone is None or not tools.backbone.sees_far_frames:
        return found
    other = measure_by_window(a, b, tools.backbone, a.prediction.intrinsics[a.matched], config)
    sigmas = disagreement(found, other)
    numbers["disagreement"] = sigmas
    if sigmas > config.closures.max_disagreement:
        raise DegenerateGeometryError(
            f"matches and loop window are {sigmas:.1f} sigmas apart, "
            f"at most {config.closures.max_disagreement:.1f}"
        )
    both = fuse(found, other)
    _note(both, numbers)
    return both


def _note(found: Measurement, numbers: dict[str, Any]) -> None:
    numbers.update(residual=found.residual, scale=found.a_from_b.scale, source=found.source)
    numbers.setdefault("inliers", found.inliers)


def _check_similarity(
    candidate: CandidateEnds,
    measurement: Measurement,
    config: ClosuresConfig,
    numbers: dict[str, Any],
) -> None:
    """Refuse depths that do not fit, a scale far from the chain's, another heading."""
    if measurement.residual > config.max_residual:
        raise DegenerateGeometryError(
            f"depths differ by {measurement.residual:.2f}, at most {config.max_residual:.2f}"
        )
    scale = measurement.a_from_b.scale
    apart = abs(candidate.a.window - candidate.b.window)
    sigma = float(np.hypot(config.scale_drift * np.sqrt(apart), candidate.guess_sigma))
    band = config.max_scale_ratio * float(np.exp(_SURE * sigma))
    if abs(np.log(scale / candidate.chain_scale)) > np.log(band):
        raise DegenerateGeometryError(
            f"scale {scale:.3g}, where the chain says {candidate.chain_scale:.3g} "
            f"within a factor of {band:.2g}"
        )
    heading = _heading_deg(candidate.a, candidate.b, measurement.a_from_b)
    numbers["heading_deg"] = heading
    if heading > config.max_heading_deg:
        raise DegenerateGeometryError(
            f"the cameras look {heading:.0f} degrees apart, at most {config.max_heading_deg:.0f}"
        )


def _heading_deg(a: End, b: End, a_from_b: Sim3) -> float:
    axis_a = a.prediction.window_from_cam[a.matched, :3, 2]
    axis_b = a_from_b.rotation @ b.prediction.window_from_cam[b.matched, :3, 2]
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(axis_a, axis_b)), axis_a @ axis_b)))


def _check_clouds(
    a: End, b: End, measurement: Measurement, config: ClosuresConfig, numbers: dict[str, Any]
) -> Measurement:
    """Refuse clouds that do not lie on one another; return what their registration improved."""
    cloud_a, cloud_b = make_cloud(a, config), make_cloud(b, config)
    found = compare(cloud_a, cloud_b, measurement.a_from_b, config)
    _note_clouds(found, numbers)
    if found.covisible < config.min_covisible:
        raise DegenerateGeometryError(
            f"the ends see {found.covisible:.2f} of each other's surfaces, "
            f"need {config.min_covisible:.2f}"
        )
    if found.overlap < config.min_overlap:
        raise DegenerateGeometryError(
            f"the clouds overlap by {found.overlap:.2f}, need {config.min_overlap:.2f}"
        )
    pivot = a.prediction.window_from_cam[a.matched, :3, 3]
    motion = align_clouds(cloud_a, cloud_b, measurement, pivot, config)
    _check_motion(motion, measurement.a_from_b.apply(cloud_b.points), cloud_a, config)
    refined = motion @ measurement.a_from_b
    after = compare(cloud_a, cloud_b, refined, config)
    if after.residual >= found.residual or after.overlap < found.overlap:
        return measurement
    _note_clouds(after, numbers)
    return replace(measurement, a_from_b=refined)


def _note_clouds(found: Comparison, numbers: dict[str, Any]) -> None:
    residual = found.residual if np.isfinite(found.residual) else None
    numbers.update(covisible=found.covisible, overlap=found.overlap, cloud_residual=residual)


def _check_motion(motion: Sim3, points: Array, cloud: EndCloud, config: ClosuresConfig) -> None:
    """Refuse a measurement that the clouds contradict."""
    move, turn_deg = displacement(motion, points, cloud.unit)
    if move > config.max_move or turn_deg > config.max_turn_deg:
        raise DegenerateGeometryError(
            f"registration of the clouds moves them by {move:.2f} median depths and "
            f"{turn_deg:.1f} degrees, at most {config.max_move:.2f} and {config.max_turn_deg:.1f}"
        )
