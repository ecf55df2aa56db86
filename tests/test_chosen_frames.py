"""What published evaluations leave on disk, and pair: read as theirs and as it is."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from corridor import SIZE, true_intrinsics, true_pose, view
from image_files import write_png
from layouts import (
    CORRIDOR,
    LAYOUTS,
    choose_bonn,
    choose_kitti_depth,
    choose_scannet,
    choose_tum,
    counts,
    scannet_by_cpp,
    write_layout,
)
from numpy.typing import NDArray

from laser_slam.camera import project, rays
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.bonn import LENS as BONN_LENS
from laser_slam.datasets.bonn import Bonn
from laser_slam.datasets.kitti_depth import KittiDepth
from laser_slam.datasets.scannet import ScanNet
from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.datasets.timed_lists import MAX_GAP_S, associate
from laser_slam.datasets.tum_rgbd import DISTORTIONS, TumRgbd
from laser_slam.datasets.waymo import Waymo
from laser_slam.errors import DatasetError

NUM, STEP = 9, 3


def seen(dataset: Dataset) -> list[int]:
    """Return which frames of the corridor the images show."""
    images = np.stack([view(frame)[0] for frame in range(NUM + 1)]).astype(int)
    found = []
    for frame in dataset.frames():
        assert frame.image is not None
        found.append(int(np.abs(images - frame.image).mean(axis=(1, 2, 3)).argmin()))
    return found


def assert_truth(dataset: Dataset, frames: list[int], units_per_m: float, step: int = 1) -> None:
    """Compare poses and depth of all frames with those of the corridor's frames."""
    truth = dataset.info.truth
    if truth is not None:
        assert list(truth.frames) == list(range(len(frames)))
    for index, frame in enumerate(frames):
        if truth is not None:
            np.testing.assert_allclose(truth.world_from_cam[index], true_pose(frame), atol=1e-7)
        depth = dataset.true_depth(index)
        assert depth is not None
        pixels = (slice(1, None, step),) * 2
        stored = counts(frame, units_per_m)[pixels]
        np.testing.assert_allclose(np.nan_to_num(depth)[pixels] * units_per_m, stored, rtol=1e-6)


def test_the_images_that_monst3r_takes_of_tum_are_those_of_every_third_posed_frame(
    tmp_path: Path,
) -> None:
    folder = write_layout("tum-rgbd", tmp_path, NUM)
    chosen = choose_tum(folder, STEP, 90)
    dataset = TumRgbd(chosen, posed_only=True)
    assert seen(dataset) == [0, 3, 6]
    assert_truth(dataset, [0, 3, 6], 5000)
    assert dataset.info.name == LAYOUTS["tum-rgbd"].name
    assert dataset.info.intrinsics is not None
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (folder / name).unlink()
    bare = TumRgbd(chosen)
    assert bare.info.truth is not None
    np.testing.assert_allclose(bare.info.truth.world_from_cam[2], true_pose(6), atol=1e-7)
    assert bare.true_depth(0) is None
    with pytest.raises(DatasetError, match=r"no rgb.txt in .*; give .*/rgb_90$"):
        TumRgbd(folder)


def test_bonn_by_rank_pairs_as_the_published_numbers_do_and_by_time_as_it_was(
    tmp_path: Path,
) -> None:
    folder = write_layout("bonn", tmp_path, NUM)
    dropped = sorted((folder / "depth").iterdir())[4]
    dropped.unlink()
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(line for line in lines if dropped.name not in line))
    by_time, by_rank = Bonn(folder), Bonn(folder, by_rank=True)
    assert seen(by_time) == seen(by_rank) == list(range(NUM))
    assert by_time.true_depth(4) is None
    assert by_rank.true_depth(NUM - 1) is None
    for index in (3, 5, 7):
        now, later = by_time.true_depth(index), by_rank.true_depth(index)
        assert now is not None
        assert later is not None
        np.testing.assert_allclose(np.nan_to_num(now) * 5000, counts(index, 5000), rtol=1e-6)
        after = index + (index >= 4)
        np.testing.assert_allclose(np.nan_to_num(later) * 5000, counts(after, 5000), rtol=1e-6)


def test_the_images_that_monst3r_takes_of_bonn_are_read_with_its_depth(tmp_path: Path) -> None:
    folder = write_layout("bonn", tmp_path, NUM)
    chosen = choose_bonn(folder, 2, 5)
    for dataset in (Bonn(chosen), Bonn(chosen, by_rank=True)):
        assert seen(dataset) == [2, 3, 4, 5, 6]
        assert_truth(dataset, [2, 3, 4, 5, 6], 5000)
    (folder / "groundtruth.txt").unlink()  # groundtruth_110.txt is of other times, but for some
    truth = Bonn(chosen).info.truth
    assert truth is not None
    assert list(truth.frames) == [0, 1]
    np.testing.assert_allclose(truth.world_from_cam[1], true_pose(3), atol=1e-7)


@pytest.mark.parametrize("is_bare", [False, True])
def test_the_images_that_monst3r_takes_of_scannet_are_those_of_every_third(
    tmp_path: Path, is_bare: bool
) -> None:
    folder = write_layout("scannet", tmp_path, NUM)
    chosen = choose_scannet(folder, STEP, 3)
    if is_bare:
        for name in ("color", "depth", "pose"):
            (folder / name).rename(tmp_path / name)
    dataset = ScanNet(chosen)
    assert seen(dataset) == [0, 3, 6]
    assert [round(frame.time_s * 30) for frame in dataset.frames()] == [0, 3, 6]
    assert_truth(dataset, [0, 3, 6], 1000, step=2)
    assert dataset.info.name == "scannet-scene0707_00"
    np.testing.assert_allclose(dataset.info.intrinsics, true_intrinsics(), atol=1e-6)
    if is_bare:
        with pytest.raises(DatasetError, match=r"no folder .*color; give .*/color_90 for the fr"):
            ScanNet(folder)


def test_lost_frames_of_the_chosen_of_scannet_have_no_pose_and_cut_lists_are_refused(
    tmp_path: Path,
) -> None:
    chosen = choose_scannet(write_layout("scannet", tmp_path, NUM), STEP, 3)
    path = chosen.with_name("pose_90.txt")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], " ".join(["-inf"] * 16), lines[2]]))
    truth = ScanNet(chosen).info.truth
    assert truth is not None
    assert list(truth.frames) == [0, 2]
    path.write_text("\n".join(lines[:2]))
    with pytest.raises(DatasetError, match=r"pose_90.txt has 2 lines for 3 images"):
        ScanNet(chosen)
    path.write_text("\n".join([*lines[:2], "1 2 3"]))
    with pytest.raises(DatasetError, match=r"line 3 of .*pose_90.txt must hold 4x4 numbers"):
        ScanNet(chosen)


def test_what_the_other_reader_of_scannet_exports_is_the_same_scene(tmp_path: Path) -> None:
    scannet_by_cpp(tmp_path / "scene0707_00", 4, CORRIDOR)
    dataset = ScanNet(tmp_path / "scene0707_00")
    assert seen(dataset) == [0, 1, 2, 3]
    assert_truth(dataset, [0, 1, 2, 3], 1000, step=2)
    np.testing.assert_allclose(dataset.info.intrinsics, true_intrinsics(), rtol=1e-6)


def test_a_scene_that_was_not_exported_says_how(tmp_path: Path) -> None:
    (tmp_path / "scene0707_00.sens").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"there is scene0707_00.sens: export it with ScanNet's"):
        ScanNet(tmp_path)


def test_the_images_that_monst3r_takes_of_kitti_depth_are_read_from_either_side(
    tmp_path: Path,
) -> None:
    chosen = choose_kitti_depth(write_layout("kitti-depth", tmp_path, NUM), 5)
    for name in ("image_gathered", "groundtruth_depth_gathered"):
        dataset = KittiDepth(chosen.parent.with_name(name) / chosen.name)
        assert seen(dataset) == [0, 1, 2, 3, 4]
        assert_truth(dataset, [0, 1, 2, 3, 4], 256)
        assert dataset.info.name == LAYOUTS["kitti-depth"].name


def test_a_whole_sequence_may_be_called_as_chosen_frames_are(tmp_path: Path) -> None:
    for key, name in {
        "tum-rgbd": "rgb_freiburg3",
        "bonn": "rgb_desk",
        "scannet": "color_2",
    }.items():
        folder = write_layout(key, tmp_path, NUM).rename(tmp_path / name)
        assert LAYOUTS[key].open(folder).info.num_frames == NUM


def official_association(first: list[float], second: list[float]) -> dict[int, int]:
    """Do what TUM's ``associate.py`` says it does, slowly: the best of all pairs that are left."""
    left = {(i, j) for i in range(len(first)) for j in range(len(second))}
    pairs = {}
    while left:
        i, j = min(left, key=lambda pair: (abs(first[pair[0]] - second[pair[1]]), pair))
        if abs(first[i] - second[j]) >= MAX_GAP_S:
            break
        pairs[i] = j
        left = {(a, b) for a, b in left if a != i and b != j}
    return pairs


@pytest.mark.parametrize("seed", range(12))
def test_times_are_paired_as_the_benchmarks_own_tool_does(seed: int) -> None:
    """With clocks that jitter and drop, so that two images want the same line."""
    rng = np.random.default_rng(seed)
    times_s = np.sort(rng.uniform(0, 0.4, 25))
    others_s = np.sort(rng.uniform(0, 0.4, 20))
    expected = official_association(times_s.tolist(), others_s.tolist())
    assert associate(times_s, others_s) == expected
    nearest = {int(i): int(np.abs(others_s - times_s[i]).argmin()) for i in expected}
    assert nearest != expected  # or nothing is tested


def test_depth_that_was_moved_to_the_colour_camera_is_read_where_it_lies(tmp_path: Path) -> None:
    folder = write_layout("7scenes", tmp_path, 3)  # .depth.png is the other way round
    moved = SevenScenes(folder)
    assert_truth(moved, [0, 1, 2], 1000)
    assert moved.info.intrinsics is not None
    assert moved.info.intrinsics[0, 0] == pytest.approx(525 * SIZE[1] / 640)
    (folder / "frame-000001.depth.proj.png").unlink()
    assert SevenScenes(folder).true_depth(1) is None  # two kinds do not mix


def test_an_archive_of_7_scenes_inside_the_archive_is_named(tmp_path: Path) -> None:
    (tmp_path / "seq-03.zip").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"holds seq-03.zip; unpack it"):
        SevenScenes(tmp_path)


def bend(image: NDArray, K: NDArray[np.float64], k: NDArray[np.float64]) -> NDArray:
    """Return what a lens makes of an image, by the pinhole pixel of each bent one."""
    height, width = image.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2)
    points = cv2.undistortPoints(grid.astype(np.float64), K, k, None, None, K)
    pixels = points.reshape(height, width, 2).astype(np.float32)
    interpolation = cv2.INTER_CUBIC if image.ndim == 3 else cv2.INTER_NEAREST
    return np.asarray(cv2.remap(image, pixels, None, interpolation, None, cv2.BORDER_REFLECT))


def tum_of_bent_images(folder: Path, K: NDArray[np.float64]) -> None:
    write_layout("tum-rgbd", folder.parent, 2)
    (folder.parent / LAYOUTS["tum-rgbd"].place).rename(folder)
    bent = np.array(DISTORTIONS["freiburg1"])
    for path in folder.glob("rgb/*.png"):
        write_png(path, bend(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB), K, bent))
    for path in folder.glob("depth/*.png"):
        write_png(path, bend(cv2.imread(str(path), -1), K, bent))


def test_a_rectified_sequence_is_what_a_pinhole_camera_sees(tmp_path: Path) -> None:
    """Bend the corridor as the lens of freiburg1 does, read it, and compare with its own planes."""
    folder = tmp_path / "rgbd_dataset_freiburg1_corridor"
    write_layout("tum-rgbd", tmp_path, 1)
    K = TumRgbd(
        (tmp_path / LAYOUTS["tum-rgbd"].place).rename(tmp_path / "freiburg1")
    ).info.intrinsics
    assert K is not None
    tum_of_bent_images(folder, K)
    bent, straight = TumRgbd(folder), TumRgbd(folder, rectify=True)
    assert bent.info.intrinsics_source.endswith("lens distortion left in")
    assert straight.info.intrinsics_source.endswith("lens distortion taken out")
    assert len(bent.info.files) == 2
    assert straight.info.files == ()  # what lies there is of another camera
    new = straight.info.intrinsics
    assert new is not None
    assert new[0, 0] > K[0, 0]  # a little narrower
    pixels = project(rays(new, *SIZE).reshape(-1, 3), K).reshape(*SIZE, 2).astype(np.float32)
    for frame, read in enumerate(straight.frames()):
        assert read.image is not None
        expected = cv2.remap(view(frame)[0], pixels, None, cv2.INTER_CUBIC)
        inner = (slice(6, -6), slice(6, -6))
        error = np.abs(read.image.astype(int) - expected)[inner]
        wrong = np.abs(next(bent.frames()).image.astype(int) - expected)[inner]  # type: ignore[union-attr]
        assert error.mean() < 0.25 * wrong.mean()
        depth = straight.true_depth(frame)
        assert depth is not None
        true = cv2.remap(view(frame)[1], pixels, None, cv2.INTER_NEAREST)
        share = np.abs(depth / true - 1)[inner]
        assert np.nanmedian(share) < 0.02


@pytest.mark.parametrize(
    ("key", "reader", "expected"),
    [
        ("tum-rgbd", TumRgbd, "rectified before release"),
        ("bonn", Bonn, "lens distortion taken out"),
        ("waymo", Waymo, "the .npz files, first frame"),
    ],
)
def test_only_what_is_bent_is_straightened(
    key: str, reader: Callable[..., Dataset], expected: str, tmp_path: Path
) -> None:
    folder = write_layout(key, tmp_path, 2)
    as_it_is, straight = reader(folder), reader(folder, rectify=True)
    assert straight.info.intrinsics_source.endswith(expected)
    same = np.array_equal(next(as_it_is.frames()).image, next(straight.frames()).image)  # type: ignore[arg-type]
    assert same == (key != "bonn")
    assert bool(straight.info.files) == (key != "bonn")
    assert not as_it_is.info.intrinsics_source.endswith("taken out")


def test_waymo_says_of_its_lens_what_the_files_say(tmp_path: Path) -> None:
    folder = write_layout("waymo", tmp_path, 2)
    k = np.array([0.04, -0.34, 0.0, 0.0, 0.0])
    for path in folder.glob("*.npz"):
        with np.load(path) as stored:
            content = {**stored, "distortion": k}
        np.savez(path, **content)
    assert Waymo(folder).info.intrinsics_source.endswith("lens distortion left in")
    assert Waymo(folder, rectify=True).info.intrinsics_source.endswith("taken out")


def test_a_lens_that_nobody_knows_cannot_be_straightened(tmp_path: Path) -> None:
    folder = write_layout("tum-rgbd", tmp_path, 2).rename(tmp_path / "corridor")
    with pytest.raises(DatasetError, match=r"--rectify needs the lens, which is unknown: no freib"):
        TumRgbd(folder, rectify=True)


def test_the_published_distortion_of_bonn_moves_its_corners_by_some_pixels() -> None:
    assert BONN_LENS.intrinsics is not None
    assert BONN_LENS.distortion is not None
    corner = np.array([[[0.0, 0.0]]])
    moved = cv2.undistortPoints(corner, BONN_LENS.intrinsics, BONN_LENS.distortion, None,
                                BONN_LENS.intrinsics)  # fmt: skip
    assert 2 < np.linalg.norm(moved) < 8
