"""A video file, streamed."""

from __future__ import annotations

import math
import os
from contextlib import closing
from itertools import repeat
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.config import DatasetConfig
from laser_slam.datasets.decoding import Stream, give_up_if_unreadable, read_ahead
from laser_slam.datasets.intrinsics import choose_intrinsics
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo

DEFAULTS = DatasetConfig()
MAX_FPS = 1000.0  # containers without a rate report their time base instead


class VideoFile:
    """The frames of a video, decoded a few ahead and never all in memory.

    Frames are upright as OpenCV turns them by the rotation in the file.

    Args:
        path: of the file.
        intrinsics: (3, 3) in pixels of the upright frames; None: not given.
        fov_deg: horizontal field of view; None: not given.
        stride: every so many-th frame is read; the frames that are left are numbered from 0.

    Raises:
        DatasetError: no such file, no video, no frames in it, or impossible intrinsics.
    """

    def __init__(
        self,
        path: Path,
        intrinsics: NDArray[np.float64] | None = None,
        fov_deg: float | None = None,
        stride: int = DEFAULTS.stride,
    ) -> None:
        self._path, self._stride = path, stride
        capture = _open(path)
        try:
            found, first = capture.read()
            if not found:
                raise DatasetError(f"no frames can be read from {path}; convert it to MP4 (H.264)")
            size = (int(first.shape[0]), int(first.shape[1]))
            num = _num_frames(capture)
        finally:
            capture.release()
        num = None if num is None else -(-num // stride)
        matrix, source = choose_intrinsics(size, intrinsics, fov_deg)
        self._info = SequenceInfo(path.resolve().stem, size, num, matrix, source, files=(path,))

    @property
    def info(self) -> SequenceInfo:
        """Say what is known before the frames are read."""
        return self._info

    def frames(self) -> Stream[Frame]:
        """Read the frames in order, a few ahead; an undecodable one comes as None.

        Raises:
            DatasetError: the first frame or more than half of all are undecodable.
        """
        return give_up_if_unreadable(self._stream(), self._path, self._info.num_frames)

    def true_depth(self, frame: int) -> None:
        """Return None: a video has no truth."""

    def _stream(self) -> Stream[Frame]:
        reader = _Reader(_open(self._path), self._stride)
        # One thread: a video is decoded in order.
        with closing(reader), closing(read_ahead(repeat(reader.next_frame), threads=1)) as frames:
            for frame in frames:
                if frame is None:
                    return
                yield frame


class _Reader:
    """Step through an open capture, with times that always rise."""

    def __init__(self, capture: Any, stride: int) -> None:
        self._capture, self._stride = capture, stride
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        self._period_s = 1 / (rate if 0 < rate <= MAX_FPS else DEFAULTS.fps)
        self._num_grabbed = self._index = 0
        self._time_s = -math.inf

    def next_frame(self) -> Frame | None:
        """Decode the next frame that the stride keeps; None: the end."""
        while True:
            if not self._capture.grab():
                return None
            self._advance_time()
            self._num_grabbed += 1
            if (self._num_grabbed - 1) % self._stride == 0:
                break
        found, image = self._capture.retrieve()
        frame = Frame(self._index, self._time_s, _as_rgb(image) if found else None)
        self._index += 1
        return frame

    def _advance_time(self) -> None:
        """Take the file's time stamp, or the frame rate where it stands still or jumps back."""
        stamp_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000
        if math.isfinite(stamp_s) and stamp_s > self._time_s:
            self._time_s = stamp_s
        else:
            self._time_s = max(self._time_s, -self._period_s) + self._period_s

    def close(self) -> None:
        """Release the file."""
        self._capture.release()


def _open(path: Path) -> Any:
    if not path.is_file():
        raise DatasetError(f"no video file {path}; give a file such as drive.mp4")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its own complaints would mix with ours
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        capture.release()
        raise DatasetError(f"{path} is no video that OpenCV can read; convert it to MP4 (H.264)")
    return capture


def _num_frames(capture: Any) -> int | None:
    """Return the frame count if the file keeps its word at the end, else None."""
    num = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if num < 1 or not capture.set(cv2.CAP_PROP_POS_FRAMES, num - 1):
        return None
    return num if capture.grab() and not capture.grab() else None


def _as_rgb(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    is_grey = image.ndim == 2 or image.shape[2] == 1
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if is_grey else cv2.COLOR_BGR2RGB))
