"""Drives that are chained without images, and the loops that are closed on them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from revisits import LoopClosure, RevisitRule, find_revisits

from laser_slam.backbones.simulated import SimulatedBackbone
from laser_slam.closures.ends import End
from laser_slam.closures.loop_window import measure_by_window
from laser_slam.config import Config
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation import absolute_errors, align
from laser_slam.evaluation.trajectory import path_distances
from laser_slam.sim3 import Array, Sim3, rotation_log
from laser_slam.slam import Slam
from laser_slam.types import Frame, Image, Prediction, Trajectory
from laser_slam.windows import cut_windows

MIN_STEP_M = 0.1  # a car that waits gives no keyframes


class Stopwatch:
    """CPU seconds by name."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Charge what is done inside to a name."""
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start


@dataclass(frozen=True)
class ChainedDrive:
    """A drive after its windows were chained, no loop closed.

    Attributes:
        config: all settings.
        truth: of all frames, metres.
        backbone: gives every window again when asked.
        intrinsics: (3, 3) in pixels of the depth maps.
        slam: the chain.
    """

    config: Config
    truth: Trajectory
    backbone: SimulatedBackbone
    intrinsics: Array
    slam: Slam

    @property
    def path_m(self) -> float:
        """Return the length of the true path."""
        return float(path_distances(self.truth)[-1])

    def ate_m(self, slam: Slam) -> float:
        """Return the rms error of the keyframes' places after a Sim(3) alignment, metres."""
        estimate = slam.trajectory(self.truth.times_s)
        aligned = align(estimate, self.truth, with_scale=True)
        errors = absolute_errors(estimate, self.truth, aligned)
        return float(np.sqrt(np.mean(errors**2)))

    def seen_truth(self) -> Trajectory:
        """Return the truth of the keyframes."""
        frames = self.slam.trajectory(self.truth.times_s).frames
        return Trajectory(frames, self.truth.times_s[frames], self.truth.world_from_cam[frames])

    def end(self, frame: int) -> End:
        """Return the window that owns a keyframe, predicted again; that gives the same."""
        node = next(node for node in self.slam.nodes if frame in node.frames[node.is_owned])
        prediction = self.backbone.predict([], node.frames, self.intrinsics)
        matched = int(np.searchsorted(node.frames, frame))
        return End(node.index, prediction, _no_colors(prediction), matched)

    def unit_m(self, end: End) -> float:
        """Return the metres in a unit of the end's window."""
        poses = Trajectory(end.prediction.frames, *_timed(end.prediction))
        return align(poses, self.truth, with_scale=True).scale


@dataclass(frozen=True)
class Outcome:
    """What became of the closures of a drive.

    Attributes:
        ate_m: after all of them.
        kept: right and wrong closures that the graph trusts.
        given: right and wrong closures that it was given.
        misfit: median of the right ones, in sigmas; 2 to 4 is usual. NaN: there are none.
        seconds: CPU, of all optimisations, one for each closure.
    """

    ate_m: float
    kept: tuple[int, int]
    given: tuple[int, int]
    misfit: float
    seconds: float


def chain_drive(
    drive: SyntheticDrive, config: Config, clock: Stopwatch, advance: Callable[[int], None]
) -> ChainedDrive:
    """Chain the windows of a drive.

    Args:
        drive: through a city.
        config: all settings.
        clock: is charged for ``predict`` and ``register``.
        advance: is told how many frames were done.
    """
    info = drive.info
    if info.truth is None or info.intrinsics is None:
        raise ValueError("a generated drive knows its truth")
    backbone = SimulatedBackbone(config.backbone, info, drive.true_depth)
    chained = ChainedDrive(config, info.truth, backbone, info.intrinsics, Slam(config, clock))
    last = 0
    for window in cut_windows(_keyframes(info.truth), config.windows, lambda image: image):
        with clock("predict"):
            prediction = backbone.predict([], window.frames, info.intrinsics)
        chained.slam.add(prediction, _no_colors(prediction))
        advance(int(window.frames[-1]) - last)
        last = int(window.frames[-1])
    return chained


def _keyframes(truth: Trajectory) -> Iterator[Frame]:
    travelled, last = path_distances(truth), -np.inf
    for index, time_s, way in zip(truth.frames, truth.times_s, travelled, strict=True):
        if way - last >= MIN_STEP_M:
            last = way
            yield Frame(int(index), float(time_s), np.zeros((1, 1, 3), np.uint8))


def _timed(prediction: Prediction) -> tuple[Array, Array]:
    return prediction.frames.astype(np.float64), prediction.window_from_cam


def _no_colors(prediction: Prediction) -> Image:
    return np.broadcast_to(np.zeros(1, np.uint8), (*prediction.depth.shape, 3))


def measure_revisits(
    drive: ChainedDrive, rule: RevisitRule, clock: Stopwatch
) -> tuple[list[LoopClosure], Array]:
    """Measure every true revisit through a window of both ends, in the order of the drive.

    Returns:
        The closures, and (M, 2) how far each puts the matched cameras from where they truly are
        to one another: degrees, metres. What cannot be measured is missing.
    """
    closures, errors = [], []
    for older, newer in find_revisits(drive.seen_truth(), rule).tolist():
        a, b = drive.end(older), drive.end(newer)
        try:
            with clock("measure"):
                found = measure_by_window(a, b, drive.backbone, drive.intrinsics, drive.config)
        except DegenerateGeometryError:
            continue
        closures.append(LoopClosure(a.window, b.window, found.a_from_b, found.sigmas, True))
        errors.append(_error(drive, a, b, found.a_from_b))
    return closures, np.array(errors).reshape(-1, 2)


def _error(drive: ChainedDrive, a: End, b: End, a_from_b: Sim3) -> tuple[float, float]:
    """Return degrees and metres by which a closure misplaces the second camera to the first."""
    found_cam = a_from_b.apply_poses(b.prediction.window_from_cam[b.matched])
    found = np.linalg.inv(a.prediction.window_from_cam[a.matched]) @ found_cam
    true_a, true_b = drive.truth.world_from_cam[[a.frame, b.frame]]
    true = np.linalg.inv(true_a) @ true_b
    found_m = found[:3, 3] * drive.unit_m(a)
    turn = rotation_log(found[:3, :3] @ true[:3, :3].T)
    return float(np.degrees(np.linalg.norm(turn))), float(np.linalg.norm(found_m - true[:3, 3]))


def close_loops(drive: ChainedDrive, closures: Sequence[LoopClosure], config: Config) -> Outcome:
    """Close loops one by one, in the order in which they would have been seen.

    Args:
        drive: stays as it is.
        closures: right and wrong ones.
        config: the settings of the pose graph count.
    """
    clock = Stopwatch()
    slam = Slam(config, clock)
    slam.nodes = list(drive.slam.nodes)
    ordered = sorted(closures, key=lambda closure: (max(closure.a, closure.b), closure.a))
    for closure in ordered:
        slam.close(closure.a, closure.b, closure.a_from_b, closure.sigmas)
    is_right = np.array([closure.is_right for closure in ordered], dtype=np.bool_)
    is_kept, misfits = np.zeros(0, np.bool_), np.zeros(0)
    if slam.optimised is not None:
        is_kept, misfits = slam.optimised.is_trusted, slam.optimised.misfits
    return Outcome(
        drive.ate_m(slam),
        (int((is_kept & is_right).sum()), int((is_kept & ~is_right).sum())),
        (int(is_right.sum()), int((~is_right).sum())),
        float(np.median(misfits[is_right])) if is_right.any() else float("nan"),
        clock.seconds["optimise"],
    )
