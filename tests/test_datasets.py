"""What all readers share: the table of their names, and reading ahead."""

import importlib
import threading
from functools import partial
from itertools import islice
from pathlib import Path

import pytest
from image_files import write_folder, write_video

from laser_slam.datasets import DATASETS
from laser_slam.datasets.decoding import read_ahead
from laser_slam.datasets.images import ImageFolder
from laser_slam.datasets.video import VideoFile


def test_every_name_in_the_table_of_data_sets_is_a_class() -> None:
    for target in DATASETS.values():
        module, _, name = target.partition(":")
        assert isinstance(getattr(importlib.import_module(module), name), type)


def test_reading_ahead_keeps_the_order_and_a_bounded_distance() -> None:
    started: list[int] = []

    def job(index: int) -> int:
        started.append(index)
        return index

    results = read_ahead(partial(job, index) for index in range(50))
    assert list(islice(results, 10)) == list(range(10))
    results.close()
    assert max(started) < 10 + 5


def test_an_error_in_a_thread_reaches_the_caller_in_its_turn() -> None:
    def fail() -> int:
        raise ValueError("broken")

    results = read_ahead([lambda: 1, fail, lambda: 3])
    assert next(results) == 1
    with pytest.raises(ValueError, match="broken"):
        next(results)


def test_closing_a_reader_leaves_no_threads(tmp_path: Path) -> None:
    before = threading.active_count()
    folder = ImageFolder(write_folder(tmp_path / "images", 30))
    video = VideoFile(write_video(tmp_path / "walk.avi", num=30))
    for frames in (folder.frames(), video.frames()):
        next(frames)
        frames.close()
        assert threading.active_count() == before
