"""Keyframes by parallax, and the overlapping windows that they fill; both lazy."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import guess_intrinsics, resize_intrinsics
from laser_slam.config import WindowsConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.sim3 import orthonormal
from laser_slam.types import Frame, Image, Window

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
Points = NDArray[np.float32]

REFERENCE_WIDTH = 640  # the thresholds of the settings are in pixels at this width
SMALL_WIDTH = 320  # of the images that corners are followed in
NUM_CORNERS = 200
MIN_CORNERS = 12  # a rotation and a percentile need some; fewer: a blank image
MIN_DISTANCE_PX = 5
CORNER_CONTRAST = 1e-4  # eigenvalue that a corner must reach: above the noise of a blank wall
PATCH_PX = (11, 11)
PYRAMID_LEVELS = 4
MAX_BACKWARD_PX = 0.5  # forward-backward gap of a good track, at SMALL_WIDTH
MIN_TRACKED = 0.3  # share of the keyframe's corners, below which it is lost
PARALLAX_PERCENTILE = 60
NOISE_PX = 0.5  # motion below it is noise, at REFERENCE_WIDTH
IRLS_STEPS = 6


@dataclass(frozen=True)
class _Motion:
    """What moved since the last keyframe, in pixels at REFERENCE_WIDTH."""

    parallax: float
    flow: float


LOST = _Motion(np.inf, np.inf)


def select_keyframes(
    frames: Iterable[Frame],
    config: WindowsConfig,
    intrinsics: Array | None,
    size: tuple[int, int],
) -> Iterator[Frame]:
    """Pass on the frames that moved enough since the last one passed on.

    That is: by parallax, by much rotation, or beyond recognition. Unreadable and blank images are
    never passed on. The last good frame is, if it moved at all, so that the end has a pose.

    Args:
        frames: in order.
        config: the motion that makes a keyframe.
        intrinsics: (3, 3) in pixels of the images; None: unknown, roughly assumed.
        size: (height, width) of the images.
    """
    tracker = _MotionTracker(config, intrinsics, size)
    waiting: Frame | None = None
    for frame in frames:
        if frame.image is None:
            continue
        grey = tracker.shrink(frame.image)
        corners = _corners(grey)
        if len(corners) < MIN_CORNERS:
            continue
        motion = tracker.follow(grey)
        if motion.parallax >= config.min_parallax_px or motion.flow >= config.max_flow_px:
            tracker.restart(grey, corners)
            waiting = None
            yield frame
        else:
            waiting = frame
    if waiting is not None and tracker.motion.flow >= NOISE_PX:
        yield waiting


def cut_windows(
    keyframes: Iterable[Frame], config: WindowsConfig, rectify: Callable[[Image], Image]
) -> Iterator[Window]:
    """Cut keyframes into windows that share ``overlap`` of them; each as soon as it is full.

    The last window reaches back as far as it needs to be full, so it may share more.

    Args:
        keyframes: in order; those without image are skipped.
        config: size and overlap of the windows.
        rectify: makes an image of the sequence one as the backbone wants it.

    Raises:
        DegenerateGeometryError: fewer than 2 keyframes in all.
    """
    recent: deque[tuple[int, Image]] = deque(maxlen=config.size)
    num_windows = num_new = 0
    for frame in keyframes:
        if frame.image is None:
            continue
        recent.append((frame.index, rectify(frame.image)))
        num_new += 1
        if num_new == config.size - (config.overlap if num_windows else 0):
            yield _window(num_windows, recent)
            num_windows, num_new = num_windows + 1, 0
    if num_windows == 0 and len(recent) < 2:
        raise DegenerateGeometryError(_too_few(len(recent), config))
    if num_new:
        yield _window(num_windows, recent)


class _MotionTracker:
    """Follow the corners of the last keyframe from frame to frame, in small images."""

    def __init__(
        self, config: WindowsConfig, intrinsics: Array | None, size: tuple[int, int]
    ) -> None:
        width = min(SMALL_WIDTH, size[1])
        self._size = (max(1, round(size[0] * width / size[1])), width)
        if intrinsics is None:
            intrinsics = guess_intrinsics(*size)
        self._intrinsics = resize_intrinsics(intrinsics, size, self._size)
        self._previous: Grey | None = None
        self._start = self._points = np.zeros((0, 2), np.float32)
        self._num_start = 0
        self.motion = LOST

    def shrink(self, image: Image) -> Grey:
        """Return the (h, w) grey image that corners are followed in."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        size = (self._size[1], self._size[0])
        return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))

    def restart(self, grey: Grey, corners: Points) -> None:
        """Make this image, with its corners (N, 2), the one that motion is measured from."""
        self._previous = grey
        self._start = self._points = corners
        self._num_start = len(self._start)

    def follow(self, grey: Grey) -> _Motion:
        """Measure the motion since the last restart; LOST where too few corners are left."""
        if self._previous is None:
            return LOST
        points, is_kept = _track(self._previous, grey, self._points)
        self._previous = grey
        self._start, self._points = self._start[is_kept], points[is_kept]
        is_lost = len(self._points) < max(MIN_CORNERS / 2, MIN_TRACKED * self._num_start)
        self.motion = LOST if is_lost else self._measure()
        return self.motion

    def _measure(self) -> _Motion:
        unit = REFERENCE_WIDTH / self._size[1]
        flow = np.linalg.norm(self._points - self._start, axis=1)
        residual = rotation_residual(self._start, self._points, self._intrinsics)
        return _Motion(
            float(np.percentile(residual, PARALLAX_PERCENTILE)) * unit,
            float(np.median(flow)) * unit,
        )


def rotation_residual(start: Points, end: Points, intrinsics: Array) -> Array:
    """Return the flow that the best rotation of the camera leaves unexplained.

    The rotation is fitted robustly (Kabsch on bearings, reweighted), so that near points with
    parallax stand out instead of bending it.

    Args:
        start: (N, 2) pixels in one image, N >= 3.
        end: (N, 2) the same points' pixels in the other.
        intrinsics: (3, 3) of both images.

    Returns:
        (N,) lengths in pixels.
    """
    source, target = _bearings(start, intrinsics), _bearings(end, intrinsics)
    weights = np.ones(len(source))
    residual = np.zeros(len(source))
    for _ in range(IRLS_STEPS):
        rotated = source @ _kabsch(source, target, weights).T
        depth = np.maximum(rotated[:, 2:], 1e-6)
        pixels = (rotated / depth) @ intrinsics.T
        residual = np.linalg.norm(pixels[:, :2] - end, axis=1)
        weights = 1 / (1 + (residual / max(float(np.median(residual)), 1e-3)) ** 2)  # Cauchy
    return residual


def _bearings(pixels: Points, intrinsics: Array) -> Array:
    x = (pixels[:, 0] - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (pixels[:, 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    rays = np.stack([x, y, np.ones(len(x))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _kabsch(source: Array, target: Array, weights: Array) -> Array:
    return orthonormal((target * weights[:, None]).T @ source)


def _corners(grey: Grey) -> Points:
    """Find up to ``NUM_CORNERS`` corners (N, 2), none weaker than noise; few: a blank image."""
    strongest = float(cv2.cornerMinEigenVal(grey, 3).max())
    if strongest <= CORNER_CONTRAST:
        return np.zeros((0, 2), np.float32)
    quality = max(0.01, CORNER_CONTRAST / strongest)
    found = cv2.goodFeaturesToTrack(grey, NUM_CORNERS, quality, MIN_DISTANCE_PX, blockSize=3)
    return np.asarray(found, np.float32).reshape(-1, 2)


def _track(previous: Grey, current: Grey, points: Points) -> tuple[Points, NDArray[np.bool_]]:
    """Follow points by Lucas-Kanade there and back; returns all, and which of them hold."""
    if len(points) == 0:
        return points, np.zeros(0, bool)
    end, is_found = _flow(previous, current, points)
    back, is_found_back = _flow(current, previous, end)
    gap = np.linalg.norm(back - points, axis=1)
    return end, is_found & is_found_back & (gap < MAX_BACKWARD_PX)


def _flow(previous: Grey, current: Grey, points: Points) -> tuple[Points, NDArray[np.bool_]]:
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        points,
        None,
        winSize=PATCH_PX,
        maxLevel=PYRAMID_LEVELS,
    )
    return end, found.ravel() == 1


def _window(index: int, recent: Iterable[tuple[int, Image]]) -> Window:
    frames, images = zip(*recent, strict=True)
    return Window(index, np.array(frames, dtype=np.int64), tuple(images))


def _too_few(num: int, config: WindowsConfig) -> str:
    if num == 0:
        return (
            "no image shows enough texture to be followed; "
            "check the exposure and the focus of the images"
        )
    return (
        "only 1 keyframe: the camera does not move (parallax below windows.min_parallax_px = "
        f"{config.min_parallax_px:g} px); give more of the sequence, or lower the setting"
    )
