"""Videos are streamed with rising times; what is no video is refused."""

import math
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from image_files import write_video

from laser_slam.datasets.video import VideoFile
from laser_slam.errors import DatasetError


def test_a_video_gives_its_frames_with_rising_times(tmp_path: Path) -> None:
    dataset = VideoFile(write_video(tmp_path / "walk.avi"), fov_deg=90)
    frames = list(dataset.frames())
    assert (dataset.info.name, dataset.info.num_frames, dataset.info.size) == ("walk", 12, (48, 64))
    assert len(frames) == 12
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(12) / 20)
    for index, frame in enumerate(frames):
        assert frame.image is not None
        assert abs(float(frame.image.mean()) - 20 * index) < 3


def test_a_stride_keeps_every_third_frame_with_its_own_time(tmp_path: Path) -> None:
    dataset = VideoFile(write_video(tmp_path / "walk.avi", num=11), stride=3)
    frames = list(dataset.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert dataset.info.num_frames == 4
    np.testing.assert_allclose([frame.time_s for frame in frames], [0, 0.15, 0.3, 0.45])
    assert frames[3].image is not None
    assert abs(float(frames[3].image.mean()) - 180) < 3


class StandingClock:
    """A capture of grey frames whose time stamps get stuck, and whose third frame is broken."""

    def __init__(self, stamps_ms: list[float]) -> None:
        self.stamps_ms, self.position = stamps_ms, -1

    def isOpened(self) -> bool:  # noqa: N802  (OpenCV's name)
        return True

    def grab(self) -> bool:
        self.position += 1
        return self.position < len(self.stamps_ms)

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        found = self.position != 2
        return found, np.zeros((4, 6, 3), np.uint8) if found else None

    def get(self, key: int) -> float:
        return {cv2.CAP_PROP_FPS: 10.0}.get(key, self.stamps_ms[min(self.position, 4)])

    def release(self) -> None:
        pass


@pytest.mark.parametrize(
    ("stamps_ms", "times_s"),
    [
        ([0, 40, 130, 150, 260], [0, 0.04, 0.13, 0.15, 0.26]),
        ([0, 0, 0, 0, 0], [0, 0.1, 0.2, 0.3, 0.4]),
        ([math.nan] * 5, [0, 0.1, 0.2, 0.3, 0.4]),
        ([0, 50, 40, 30, 300], [0, 0.05, 0.15, 0.25, 0.3]),
    ],
)
def test_video_times_are_the_stamps_if_they_rise_else_the_frame_rate(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stamps_ms: list[float],
    times_s: list[float],
) -> None:
    dataset = VideoFile(write_video(tmp_path / "walk.avi"))
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: StandingClock(stamps_ms))
    frames = list(dataset.frames())
    np.testing.assert_allclose([frame.time_s for frame in frames], times_s)
    assert [frame.image is None for frame in frames] == [False, False, True, False, False]


def test_files_that_are_no_video_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no video file .*nowhere.mp4"):
        VideoFile(tmp_path / "nowhere.mp4")
    (tmp_path / "text.mp4").write_text("this is a text\n" * 100)
    with pytest.raises(DatasetError, match=r"text.mp4 is no video that OpenCV can read"):
        VideoFile(tmp_path / "text.mp4")
    write_video(tmp_path / "empty.avi", num=0)
    with pytest.raises(DatasetError, match=r"no frames can be read from .*empty.avi"):
        VideoFile(tmp_path / "empty.avi")


def test_the_video_library_keeps_its_own_complaints_to_itself(tmp_path: Path) -> None:
    """In a process of its own, for the library takes its log level once."""
    (tmp_path / "text.mp4").write_text("this is a text\n" * 100)
    script = (
        "import pathlib, sys\n"
        "from laser_slam.datasets.video import VideoFile\n"
        "from laser_slam.errors import DatasetError\n"
        "try:\n    VideoFile(pathlib.Path(sys.argv[1]))\n"
        "except DatasetError:\n    pass\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "text.mp4")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
