"""Feature tracks: corners followed from frame to frame, once per frame of the sequence."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.config import ClassicalConfig

Grey = NDArray[np.uint8]
Points = NDArray[np.float32]
GRID = (2, 4)  # cells, rows by columns, that get an equal share of the corners
MIN_DISTANCE_PX = 8  # between corners, at tracking width
PYRAMID_LEVELS = 4


@dataclass(frozen=True)
class FrameTracks:
    """The corners seen in one frame.

    Attributes:
        frame: index in the sequence.
        grey: (H, W) the image at full size.
        ids: (N,) track numbers, unique over the sequence.
        pixels: (N, 2) positions x, y at full size.
    """

    frame: int
    grey: Grey
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]


class Tracker:
    """Follow corners through consecutive frames by pyramidal Lucas-Kanade.

    Tracks are found on an image of reduced width; the memory holds the last frames only.
    """

    def __init__(self, config: ClassicalConfig, memory: int) -> None:
        self._config = config
        self._history: deque[FrameTracks] = deque(maxlen=memory)
        self._small: Grey | None = None
        self._points = np.zeros((0, 2), np.float32)
        self._velocity = np.zeros((0, 2), np.float32)
        self._ids = np.zeros(0, np.int64)
        self._next_id = 0

    @property
    def history(self) -> list[FrameTracks]:
        """Return what was seen in the last frames, oldest first."""
        return list(self._history)

    def add(self, frame: int, grey: Grey) -> None:
        """Track into the next frame and refill the lost corners.

        Args:
            frame: index in the sequence, above all earlier ones.
            grey: (H, W) image, the same size for all frames.
        """
        scale = min(1.0, self._config.track_width / grey.shape[1])
        size = (round(grey.shape[1] * scale), round(grey.shape[0] * scale))
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        if self._small is not None and len(self._points):
            self._follow(self._small, small)
        self._refill(small)
        self._small = small
        factor = np.array([grey.shape[1] / size[0], grey.shape[0] / size[1]])
        pixels = (self._points.astype(np.float64) + 0.5) * factor - 0.5
        self._history.append(FrameTracks(frame, grey, self._ids.copy(), pixels))

    def _follow(self, previous: Grey, current: Grey) -> None:
        start = self._points
        end, found = self._flow(previous, current, start, start + self._velocity)
        back, found_back = self._flow(current, previous, end, start)
        gap = np.linalg.norm(back - start, axis=1)
        bounds = np.array([current.shape[1], current.shape[0]]) - 3
        inside = np.all((end > 2) & (end < bounds), axis=1)
        is_kept = found & found_back & inside
        is_kept &= gap < self._config.max_backward_px
        self._velocity = (end - start)[is_kept]
        self._points, self._ids = end[is_kept], self._ids[is_kept]

    def _flow(
        self, first: Grey, second: Grey, points: Points, guess: Points
    ) -> tuple[Points, NDArray[np.bool_]]:
        patch = (self._config.track_patch, self._config.track_patch)
        end, found, _ = cv2.calcOpticalFlowPyrLK(
            first,
            second,
            points,
            np.array(guess),
            winSize=patch,
            maxLevel=PYRAMID_LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return end, found.ravel() == 1

    def _refill(self, small: Grey) -> None:
        mask = np.full(small.shape, 255, np.uint8)
        for x, y in np.rint(self._points).astype(int):
            cv2.circle(mask, (int(x), int(y)), MIN_DISTANCE_PX, 0, -1)
        share = self._config.num_features // (GRID[0] * GRID[1])
        rows = np.linspace(0, small.shape[0], GRID[0] + 1).astype(int)
        columns = np.linspace(0, small.shape[1], GRID[1] + 1).astype(int)
        cells = [
            _corners(small, mask, (top, bottom, left, right), share, self._points)
            for top, bottom in pairwise(rows)
            for left, right in pairwise(columns)
        ]
        new = np.concatenate(cells).astype(np.float32)
        self._points = np.concatenate([self._points, new])
        self._velocity = np.concatenate([self._velocity, self._guess_velocity(new)])
        self._ids = np.concatenate(
            [self._ids, np.arange(self._next_id, self._next_id + len(new), dtype=np.int64)]
        )
        self._next_id += len(new)

    def _guess_velocity(self, new: Points) -> Points:
        """Start new corners with the motion of the nearest old one."""
        if not len(self._velocity):
            return np.zeros_like(new)
        old = self._points[: len(self._velocity)]
        squared = ((new[:, None] - old[None]) ** 2).sum(axis=2)
        return np.asarray(self._velocity[squared.argmin(axis=1)])


def _corners(
    image: Grey,
    mask: Grey,
    cell: tuple[int, int, int, int],
    share: int,
    points: Points,
) -> Points:
    """Find the corners that a cell (top, bottom, left, right) lacks of its share."""
    top, bottom, left, right = cell
    inside = (points[:, 0] >= left) & (points[:, 0] < right)
    inside &= (points[:, 1] >= top) & (points[:, 1] < bottom)
    missing = share - int(inside.sum())
    if missing <= 0:
        return np.zeros((0, 2), np.float32)
    found = cv2.goodFeaturesToTrack(
        image[top:bottom, left:right],
        missing,
        0.01,
        MIN_DISTANCE_PX,
        mask=mask[top:bottom, left:right],
        blockSize=5,
    )
    if found is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(found.reshape(-1, 2) + np.array([left, top]), np.float32)
