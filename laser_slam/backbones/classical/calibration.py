"""Self-calibration: focal length and radial distortion that a moving camera's tracks agree with.

A lens whose distortion is left over by a few pixels at the image's border makes every point seem
to approach at another speed near the border than near the centre. In a drive that is a steady
drift of scale, the largest error of all; bundle adjustment over some windows measures it.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.calibration_kernels import NUM_SHARED, shared_equations
from laser_slam.backbones.classical.reconstruction import Reconstruction, Solver, flat_intrinsics
from laser_slam.backbones.classical.tracking import FrameTracks, Tracker
from laser_slam.backbones.classical.twoview import measure_motion
from laser_slam.camera import COMMON_FOCAL, guess_intrinsics, intrinsics_matrix
from laser_slam.config import ClassicalConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import Array, rotation_log
from laser_slam.types import NO_DISTORTION, Calibration, Window

SIGNIFICANT = 60.0  # chi-squared of 3 numbers, lenient: the windows are few and overlap
ROUNDS, SETTLED = 8, 2e-4  # at most, and the step of the unknowns at which it stops
SLACK = 1e-3  # by which the cost may seem to rise, for no bundle is adjusted to the end
HUBER_PX = 0.5  # at full width of 1280, as all pixels here
NOISE_PX = 1.5  # of a track, as if tracks were independent: five times what one measures
# Standard deviations before: relative focal length, principal point in focal lengths, k1, k2, p1,
# p2. A given principal point stays: it defines the axes that given poses are in.
KNOWN_PRIOR = (0.02, 1e-4, 1e-4, 0.1, 0.1, 1e-4, 1e-4)
SCANNED_PRIOR = (0.05, 0.02, 0.02, 0.1, 0.1, 0.005, 0.005)
GUESSED_PRIOR = (0.002, 0.002, 0.002, 0.1, 0.1, 0.001, 0.001)
FOCALS = np.geomspace(0.42, 1.3, 7).tolist()  # in image widths
LOST_PX = 1.5  # error that a lost observation counts as
MIN_CONTRAST = 0.1  # of the cost over the focals; below it, nothing is learnt
NUM_SCANNED, MIN_TURN_DEG = 3, 10.0  # windows that turn most, and how far they must
MIN_BUNDLES = 2
UNTOLD = "the clip does not tell"
DOUBTFUL = 0.04  # change of a given focal length that a person should know of
MAX_STATE = 0.5  # of any unknown; beyond it, the equations have run away


@dataclass(frozen=True)
class Clip:
    """A window's tracks.

    Attributes:
        views: what was seen in each of its frames.
        turn_deg: how far the camera turned from the first to the last.
    """

    views: list[FrameTracks]
    turn_deg: float


@dataclass(frozen=True)
class _Start:
    """What is assumed before the windows are adjusted.

    Attributes:
        intrinsics: (3, 3) in pixels.
        sigmas: (7,) of the unknowns, as listed above, around these intrinsics without distortion.
        source: where it comes from, in words.
        is_given: it stays as it is unless the windows clearly agree on another.
    """

    intrinsics: Array
    sigmas: tuple[float, ...]
    source: str
    is_given: bool = False


def calibrate(
    windows: Iterable[Window],
    intrinsics: Array | None,
    config: ClassicalConfig,
    workers: ThreadPoolExecutor,
) -> Calibration:
    """Measure how the camera projects.

    Args:
        windows: some of the sequence, in order, with images at the size that the backbone wants.
        intrinsics: (3, 3) in pixels of these images, taken as good to 2 %; None: unknown.
        config: of the tracks.
        workers: threads.

    Returns:
        The calibration at the size of the images. Where the clip does not tell, what was given, or
        a guess; ``source`` says so.

    Raises:
        DegenerateGeometryError: there is no window.
    """
    clips = follow(windows, intrinsics, config)
    if not clips:
        raise DegenerateGeometryError("no window to calibrate the camera by")
    return calibrate_clips(clips, intrinsics, config, workers)


def calibrate_clips(
    clips: list[Clip],
    intrinsics: Array | None,
    config: ClassicalConfig,
    workers: ThreadPoolExecutor,
) -> Calibration:
    """Measure how the camera projects from one or more windows' tracks; see `calibrate`."""
    known = None if intrinsics is None else _Start(intrinsics, KNOWN_PRIOR, "given", is_given=True)
    return _refine(clips, known or _guess(clips, workers), config, workers)


def follow(
    windows: Iterable[Window], intrinsics: Array | None, config: ClassicalConfig
) -> list[Clip]:
    """Follow corners through all windows; a frame that neighbours share is tracked once."""
    tracker, clips = Tracker(config, memory=1), []
    seen: dict[int, FrameTracks] = {}
    for window in windows:
        before, seen = seen, {}
        for frame, image in zip(window.frames.tolist(), window.images, strict=True):
            if frame not in before:
                tracker.add(frame, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            seen[frame] = before[frame] if frame in before else tracker.history[-1]
        views = list(seen.values())
        K = guess_intrinsics(*views[0].grey.shape) if intrinsics is None else intrinsics
        clips.append(make_clip(views, K))
    return clips


def make_clip(views: list[FrameTracks], intrinsics: Array) -> Clip:
    """Measure how far the camera turned in a window; rough intrinsics will do."""
    rotation = np.eye(3)
    for first, second in pairwise(views):
        rotation = measure_motion(first, second, intrinsics).second_from_first @ rotation
    return Clip(views, float(np.degrees(np.linalg.norm(rotation_log(rotation)))))


def _solve(clip: Clip, K: Array, refine_radius: int) -> tuple[Solver, Reconstruction | None]:
    solver = Solver(clip.views, K)
    if not solver.start_from_pair():
        return solver, None
    solver.grow()
    return solver, solver.finish(refine_radius)


def _guess(clips: list[Clip], workers: ThreadPoolExecutor) -> _Start:
    """Find the focal length at which the windows that turn most fit best."""
    height, width = clips[0].views[0].grey.shape
    turning = sorted(clips, key=lambda clip: (-clip.turn_deg, clip.views[0].frame))[:NUM_SCANNED]
    turning = [clip for clip in turning if clip.turn_deg > MIN_TURN_DEG]
    focal, contrast = _scan_focal(turning, workers) if turning else (COMMON_FOCAL, 0.0)
    measured = f"(contrast {contrast:.2f})"
    if contrast < MIN_CONTRAST:
        guess = guess_intrinsics(height, width)
        source = f"guessed: the clip turns too little to tell {measured}"
        return _Start(guess, GUESSED_PRIOR, source)
    source = f"estimated from the images {measured}"
    if not FOCALS[0] <= focal <= FOCALS[-1]:
        source += ", at the end of what was tried"
    return _Start(guess_intrinsics(height, width, focal), SCANNED_PRIOR, source)


def _scan_focal(clips: list[Clip], workers: ThreadPoolExecutor) -> tuple[float, float]:
    """Try focal lengths; return the best, in image widths, and its contrast to the others."""
    cost = partial(_cost, clips)
    tried = dict(zip(FOCALS, workers.map(cost, FOCALS), strict=True))
    best = min(tried, key=lambda focal: tried[focal])
    step = (FOCALS[1] / FOCALS[0]) ** (1 / 3)
    finer = [best / step**2, best / step, best * step, best * step**2]
    tried |= dict(zip(finer, workers.map(cost, finer), strict=True))
    best = min(tried, key=lambda focal: tried[focal])
    return best, 1.0 - tried[best] / float(np.median(list(tried.values())))


def _cost(clips: list[Clip], focal: float) -> float:
    """Return the mean squared error of all observations, those that were lost at LOST_PX."""
    height, width = clips[0].views[0].grey.shape
    lost = (LOST_PX * width / 1280) ** 2
    total = 0.0
    for clip in clips:
        solver, solution = _solve(clip, guess_intrinsics(height, width, focal), 0)
        total += solver.mean_squared_error(solution.bundle, LOST_PX) if solution else lost
    return total / len(clips)


def _refine(
    clips: list[Clip], start: _Start, config: ClassicalConfig, workers: ThreadPoolExecutor
) -> Calibration:
    """Adjust all windows and the calibration together."""
    height, width = clips[0].views[0].grey.shape
    K, size = start.intrinsics, (height, width)
    solved = workers.map(lambda clip: _solve(clip, K, config.refine_radius)[1], clips)
    bundles = [solution.bundle for solution in solved if solution is not None]
    on = f"on {len(bundles)} windows"
    if len(bundles) < MIN_BUNDLES:
        return Calibration(K, NO_DISTORTION, size, f"{start.source}, unrefined: too little moves")
    found = _optimise(bundles, np.array(start.sigmas), width / 1280, workers)
    corner = np.abs([[0, 0], [width - 1, height - 1]] - K[:2, 2]).max(axis=0)
    if found is None or _folds(found[0][3:], corner / K[[0, 1], [0, 1]]):
        return Calibration(K, NO_DISTORTION, size, f"{start.source}, unrefined: {UNTOLD}")
    state, covariance = found
    free = np.ix_(np.array(start.sigmas) > 1e-3)[0]  # the others say nothing
    chi2 = state[free] @ np.linalg.pinv(covariance[np.ix_(free, free)]) @ state[free]
    if start.is_given and chi2 < SIGNIFICANT:
        return Calibration(K, NO_DISTORTION, size, f"{start.source}, confirmed {on}")
    fx, fy, cx, cy, *lens = _with(flat_intrinsics(K), state)
    words = f"{start.source}, refined {on}"
    doubt = f"the images ask for another focal length ({state[0]:+.0%}): check what was given"
    told = doubt if start.is_given and abs(state[0]) > DOUBTFUL else None
    return Calibration(intrinsics_matrix(fx, fy, cx, cy), np.array(lens), size, words, told)


def _folds(distortion: Array, corner: Array) -> bool:
    """Tell whether the lens would show something twice before the corner, a (2,) ray slope."""
    k1, k2 = distortion[:2]
    r2 = np.linspace(0, float(corner @ corner), 50)
    return bool((1 + r2 * (3 * k1 + r2 * 5 * k2)).min() <= 0)


def _optimise(
    bundles: list[Bundle], prior: Array, unit: float, workers: ThreadPoolExecutor
) -> tuple[Array, Array] | None:
    """Gauss-Newton on the shared unknowns, everything else adjusted in each round.

    Args:
        bundles: windows; their poses and points are updated in place.
        prior: (7,) standard deviations.
        unit: pixels per pixel of an image 1280 wide.
        workers: threads.

    Returns:
        (7,), and its (7, 7) covariance by how much the windows disagree; None: it does not
        converge.
    """
    given = bundles[0].intrinsics.copy()
    state = np.zeros(NUM_SHARED)
    precision = np.diag((NOISE_PX * unit / prior) ** 2)

    def equations(bundle: Bundle) -> tuple[Array, Array, float]:
        bundle.intrinsics = _with(given, state)
        cost = bundle.adjust(HUBER_PX * unit, 8) * len(bundle.cameras)
        return (*_reduced(bundle, HUBER_PX * unit), cost)

    costs = []
    for _ in range(ROUNDS):
        try:
            terms = list(workers.map(equations, bundles))
        except np.linalg.LinAlgError:
            return None
        costs.append(sum(term[2] for term in terms) + float(state @ precision @ state))
        H = precision + sum(term[0] for term in terms)
        g = -precision @ state + sum(term[1] for term in terms)
        if not (np.isfinite(H).all() and np.isfinite(g).all()):
            return None
        step = np.linalg.solve(H, g)  # the prior keeps it from being singular
        state = state + step
        if np.abs(state).max() > MAX_STATE:
            return None
        if np.abs(step).max() < SETTLED:
            if costs[-1] > costs[0] * (1 + SLACK):
                return None
            pulls = np.linalg.solve(H, np.stack([term[1] for term in terms]).T)
            return state, np.cov(pulls) * len(terms)
    return None


def _with(given: Array, state: Array) -> Array:
    """Return the (8,) intrinsics that the unknowns make of the given ones."""
    out = given.copy()
    out[2:4] += given[:2] * state[1:3]
    out[:2] *= 1 + state[0]
    out[4:] = state[3:]
    return out


def _reduced(bundle: Bundle, huber_px: float) -> tuple[Array, Array]:
    """Return (7, 7) and (7,) normal equations of the calibration, all else eliminated."""
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
