"""Self-calibration: focal length and radial distortion that a moving camera's tracks agree with.

A lens whose distortion is left over by a few pixels at the image's border makes every point seem
to approach at another speed near the border than near the centre. In a drive that is a steady
drift of scale, the largest error of all; bundle adjustment over some windows measures it.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.calibration_kernels import shared_equations
from laser_slam.backbones.classical.reconstruction import Solver
from laser_slam.backbones.classical.tracking import FrameTracks, Tracker
from laser_slam.backbones.classical.twoview import measure_motion
from laser_slam.camera import guess_intrinsics
from laser_slam.config import ClassicalConfig
from laser_slam.sim3 import Array, rotation_log
from laser_slam.types import Calibration, Window

ROUNDS = 8
SETTLED = 2e-4  # step of relative focal length, k1 and k2 at which it stops
HUBER_PX = 0.5  # at full width of 1280, as all pixels here
NOISE_PX = 1.5  # of a track, as if tracks were independent: five times what one measures
# Standard deviations of what is assumed before: relative focal length, k1, k2.
KNOWN_PRIOR = (0.02, 0.1, 0.1)
SCANNED_PRIOR = (0.05, 0.1, 0.1)
GUESSED_PRIOR = (0.002, 0.1, 0.1)
FOCALS = np.geomspace(0.42, 1.3, 7)  # in image widths
LOST_PX = 1.5  # error that a lost observation counts as
MIN_CONTRAST = 0.1  # of the cost over the focals; below it, nothing is learnt
NUM_SCANNED = 3  # windows, those that turn most
MIN_TURN_DEG = 10.0  # of a window that tells the focal length
MIN_BUNDLES = 2
MAX_DISTORTION = 0.5


@dataclass(frozen=True)
class _Clip:
    """A window's tracks, and how far the camera turned."""

    views: list[FrameTracks]
    turn_deg: float


def calibrate(
    windows: Iterable[Window],
    intrinsics: Array | None,
    config: ClassicalConfig,
    workers: ThreadPoolExecutor,
) -> Calibration:
    """Measure how the camera projects.

    Args:
        windows: some of the sequence, with images at the size that the backbone wants.
        intrinsics: (3, 3) in pixels of these images, taken as good to 2 %; None: unknown.
        config: of the tracks.
        workers: threads.

    Returns:
        The calibration at the size of the images. Where the clip does not tell, what was given, or
        a guess; ``source`` says so.
    """
    clips, size = _track(windows, intrinsics, config)
    if intrinsics is not None:
        return _refine(clips, intrinsics, size, KNOWN_PRIOR, config, workers, "given")
    guess, contrast = _scan_focal(clips, size, workers)
    if contrast < MIN_CONTRAST:
        source = f"guessed: the clip turns too little to tell (contrast {contrast:.2f})"
        return _refine(clips, guess, size, GUESSED_PRIOR, config, workers, source)
    source = f"estimated from the images (contrast {contrast:.2f})"
    return _refine(clips, guess, size, SCANNED_PRIOR, config, workers, source)


def _track(
    windows: Iterable[Window], intrinsics: Array | None, config: ClassicalConfig
) -> tuple[list[_Clip], tuple[int, int]]:
    tracker, clips, size = Tracker(config, memory=256), [], (0, 0)
    for window in windows:
        size = window.images[0].shape[:2]
        known = {view.frame for view in tracker.history}
        for frame, image in zip(window.frames, window.images, strict=True):
            if int(frame) not in known:
                tracker.add(int(frame), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        views = [view for view in tracker.history if view.frame in window.frames]
        K = guess_intrinsics(*size) if intrinsics is None else intrinsics
        clips.append(_Clip(views, _turn_deg(views, K)))
    return clips, size


def _turn_deg(views: list[FrameTracks], K: Array) -> float:
    rotation = np.eye(3)
    for first, second in pairwise(views):
        rotation = measure_motion(first, second, K).second_from_first @ rotation
    return float(np.degrees(np.linalg.norm(rotation_log(rotation))))


def _solve(clip: _Clip, K: Array, refine_radius: int) -> Bundle | None:
    solver = Solver(clip.views, K)
    if not solver.start_from_pair():
        return None
    solver.grow()
    solution = solver.finish(refine_radius)
    return None if solution is None else solution.bundle


def _scan_focal(
    clips: list[_Clip], size: tuple[int, int], workers: ThreadPoolExecutor
) -> tuple[Array, float]:
    """Try focal lengths on the windows that turn most; return the best, and its contrast."""
    turning = sorted(clips, key=lambda clip: -clip.turn_deg)[:NUM_SCANNED]
    turning = [clip for clip in turning if clip.turn_deg > MIN_TURN_DEG]
    if not turning:
        return guess_intrinsics(*size), 0.0
    tried = dict(zip(FOCALS, workers.map(lambda f: _cost(turning, f, size), FOCALS), strict=True))
    best = min(tried, key=lambda f: tried[f])
    step = float(FOCALS[1] / FOCALS[0]) ** (1 / 3)
    finer = [best / step**2, best / step, best * step, best * step**2]
    tried |= dict(zip(finer, workers.map(lambda f: _cost(turning, f, size), finer), strict=True))
    best = min(tried, key=lambda f: tried[f])
    contrast = 1.0 - tried[best] / float(np.median(list(tried.values())))
    K = guess_intrinsics(*size)
    K[0, 0] = K[1, 1] = best * size[1]
    return K, contrast


def _cost(clips: list[_Clip], focal: float, size: tuple[int, int]) -> float:
    """Return the mean squared error of all observations, those that were lost at LOST_PX."""
    K = guess_intrinsics(*size)
    K[0, 0] = K[1, 1] = focal * size[1]
    total = 0.0
    for clip in clips:
        solver = Solver(clip.views, K)
        solution = None
        if solver.start_from_pair():
            solver.grow()
            solution = solver.finish()
        total += (
            LOST_PX**2 if solution is None else solver.mean_squared_error(solution.bundle, LOST_PX)
        )
    return total / len(clips)


def _refine(  # noqa: PLR0913, PLR0917  (a step of its own, with all that it needs)
    clips: list[_Clip],
    K: Array,
    size: tuple[int, int],
    prior: tuple[float, float, float],
    config: ClassicalConfig,
    workers: ThreadPoolExecutor,
    source: str,
) -> Calibration:
    solved = workers.map(lambda clip: _solve(clip, K, config.refine_radius), clips)
    bundles = [bundle for bundle in solved if bundle is not None]
    if len(bundles) < MIN_BUNDLES:
        return Calibration(K, np.zeros(2), size, f"{source}, unrefined: too little moves")
    unit = size[1] / 1280
    found = _optimise(bundles, np.array(prior), unit, workers)
    if found is None:
        return Calibration(K, np.zeros(2), size, f"{source}, unrefined: the clip does not tell")
    focal, k1, k2 = found
    refined = K.copy()
    refined[0, 0] *= 1 + focal
    refined[1, 1] *= 1 + focal
    words = f"{source}, refined on {len(bundles)} windows"
    return Calibration(refined, np.array([k1, k2]), size, words)


def _optimise(
    bundles: list[Bundle], prior: Array, unit: float, workers: ThreadPoolExecutor
) -> Array | None:
    """Gauss-Newton on relative focal length, k1, k2, everything else adjusted in each round."""
    given = bundles[0].intrinsics.copy()
    state = np.zeros(3)
    precision = np.diag((NOISE_PX * unit / prior) ** 2)

    def equations(bundle: Bundle) -> tuple[Array, Array, float]:
        bundle.intrinsics = _with(given, state)
        cost = bundle.adjust(HUBER_PX * unit, 8) * len(bundle.cameras)
        return (*_reduced(bundle, HUBER_PX * unit), cost)

    costs = []
    for _ in range(ROUNDS):
        terms = list(workers.map(equations, bundles))
        costs.append(sum(term[2] for term in terms) + float(state @ precision @ state))
        H = precision + sum(term[0] for term in terms)
        g = -precision @ state + sum(term[1] for term in terms)
        step = np.linalg.solve(H, g)
        state = state + step
        if not np.isfinite(state).all() or np.abs(state).max() > MAX_DISTORTION:
            return None
        if np.abs(step).max() < SETTLED:
            break
    return state if costs[-1] <= costs[0] else None


def _with(given: Array, state: Array) -> Array:
    focal, k1, k2 = state
    out = given.copy()
    out[:2] *= 1 + focal
    out[4:] = k1, k2
    return out


def _reduced(bundle: Bundle, huber_px: float) -> tuple[Array, Array]:
    """Return (3, 3) and (3,) normal equations of the calibration, all else eliminated."""
    S, cross, H, s, g = shared_equations(
        bundle.rotations,
        bundle.translations,
        bundle.points,
        bundle.cameras,
        bundle.starts,
        bundle.pixels,
        bundle.intrinsics,
        huber_px,
    )
    free = np.flatnonzero(np.repeat(~bundle.is_fixed, 6))
    A = np.tril(S[np.ix_(free, free)])
    A = A + np.tril(A, -1).T
    A[np.diag_indices(len(A))] += 1e-6 * np.diag(A) + 1e-9  # the scale of a window is free
    B = cross[free]
    X = np.linalg.solve(A, np.column_stack([B, s[free]]))
    return H - B.T @ X[:, :-1], g - B.T @ X[:, -1]
