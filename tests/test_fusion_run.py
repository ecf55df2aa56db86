"""A run's map is made from its stored windows, and mended where something changed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from submaps import EVERYTHING, submap_of, wavy_depth

from laser_slam.config import Config, LayersConfig
from laser_slam.errors import RunFolderError
from laser_slam.results.mapping import TILES, fuse_run, place_window
from laser_slam.sim3 import Sim3
from laser_slam.slam import StoredWindow, read_window
from laser_slam.store import WindowFiles
from laser_slam.store.keyframes import Keyframes

CONFIG = Config(layers=LayersConfig(enabled="never"), fusion=EVERYTHING)
NUM = 3  # windows of four frames, of which each owns three


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "windows").mkdir()
    for i in range(NUM):
        submap = submap_of(wavy_depth(4, seed=i), seed=i)
        prediction = replace(submap.prediction, frames=3 * i + np.arange(4))
        WindowFiles(tmp_path).save(i, prediction, submap.colors)
    return tmp_path


def keyframes() -> Keyframes:
    places = [Sim3(1.5, translation=np.array([5.0 * (k // 3), 0, 0])) for k in range(3 * NUM)]
    poses = np.tile(np.eye(4), (3 * NUM, 1, 1))
    windows = np.repeat(np.arange(NUM), 3)
    return Keyframes(
        np.arange(3 * NUM), windows, np.stack([place.matrix() for place in places]), poses
    )


class Reader:
    """Reads windows, and notes which."""

    def __init__(self, folder: Path) -> None:
        self.files, self.read = WindowFiles(folder), list[int]()

    def __call__(self, index: int) -> StoredWindow:
        self.read.append(index)
        return read_window(self.files, index, CONFIG)


def test_a_run_is_fused_once_and_then_only_what_changed(folder: Path) -> None:
    seen: list[tuple[int, int]] = []
    reader = Reader(folder)
    tiles = fuse_run(folder, keyframes(), CONFIG, reader, lambda *done: seen.append(done))
    assert reader.read == [0, 1, 2]
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert tiles.folder == folder / TILES
    assert tiles.num_points > 500
    again = Reader(folder)
    assert fuse_run(folder, keyframes(), CONFIG, again).num_points == tiles.num_points
    assert again.read == []
    moved = keyframes()
    moved.world_from_window[-1, 0, 3] += 0.5
    fuse_run(folder, moved, CONFIG, again)
    assert 2 in again.read
    assert 0 not in again.read


def test_a_window_that_was_predicted_again_is_fused_again(folder: Path) -> None:
    fuse_run(folder, keyframes(), CONFIG, Reader(folder))
    files = WindowFiles(folder)
    prediction, colors = files.load(1)
    files.save(1, replace(prediction, depth=1.1 * prediction.depth), colors)
    reader = Reader(folder)
    fuse_run(folder, keyframes(), CONFIG, reader)
    assert 1 in reader.read


def test_frames_go_where_their_own_place_says(folder: Path) -> None:
    """The last frame of each window belongs to the next one."""
    submap = place_window(keyframes(), 1, Reader(folder)(1))
    assert submap.is_owned.tolist() == [True, True, True, False]
    assert [place.translation[0] for place in submap.places[:3]] == [5.0, 5.0, 5.0]
    bent = keyframes()
    bent.world_from_window[4, 2, 3] = 7.0
    submap = place_window(bent, 1, Reader(folder)(1))
    assert [place.translation[2] for place in submap.places[:3]] == [0.0, 7.0, 0.0]


def test_a_window_that_is_gone_is_said_in_a_line(folder: Path) -> None:
    (folder / "windows" / "000001.npz").unlink()
    with pytest.raises(RunFolderError, match=r"cannot read window file .*000001\.npz"):
        fuse_run(folder, keyframes(), CONFIG, Reader(folder))
