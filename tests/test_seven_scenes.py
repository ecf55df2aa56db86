"""7-Scenes: the official layout, depth in millimetres, and frames whose tracking was lost."""

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from image_files import HEIGHT, WIDTH, cut_file, textured, write_png
from numpy.typing import NDArray
from typer.testing import CliRunner

from laser_slam.camera import project, unproject
from laser_slam.cli import app
from laser_slam.datasets.decoding import read_depth, read_image
from laser_slam.datasets.seven_scenes import CAM_FROM_DEPTH_CAM, SevenScenes
from laser_slam.errors import DatasetError
from laser_slam.sim3 import rotation_exp
from laser_slam.types import Image

NUM = 4


def pose(index: int) -> NDArray[np.float64]:
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = rotation_exp(np.array([0.1, 0.2 * index, 0.0]))
    world_from_cam[:3, 3] = [0.1 * index, 1.0, -0.2]
    return world_from_cam


def depth_mm(index: int) -> NDArray[np.uint16]:
    depth = np.random.default_rng(index).integers(400, 5000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65535
    return depth


def write_sequence(
    folder: Path, numbers: tuple[int, ...] = tuple(range(NUM)), ending: str = ".depth.png"
) -> Path:
    for number in numbers:
        stem = folder / f"frame-{number:06d}"
        write_png(stem.with_suffix(".color.png"), textured(number))
        write_png(stem.with_suffix(ending), depth_mm(number))
        np.savetxt(stem.with_suffix(".pose.txt"), pose(number))
    return folder


def test_a_sequence_has_images_times_poses_and_nominal_intrinsics(tmp_path: Path) -> None:
    dataset = SevenScenes(write_sequence(tmp_path / "kitchen" / "seq-01"))
    info, frames = dataset.info, list(dataset.frames())
    assert info.name == "7scenes-kitchen-seq-01"
    assert (info.size, info.num_frames) == ((HEIGHT, WIDTH), NUM)
    assert info.truth is not None
    assert info.intrinsics is not None
    assert info.intrinsics[0, 0] == pytest.approx(52.5)  # 525 at 640 pixels
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, textured(index))
        assert frame.time_s == pytest.approx(index / 30)
        np.testing.assert_allclose(info.truth.world_from_cam[index], pose(index), atol=1e-12)


def test_depth_is_in_metres_and_both_marks_of_nothing_are_nan(tmp_path: Path) -> None:
    dataset = SevenScenes(write_sequence(tmp_path, ending=".depth.proj.png"))
    depth = dataset.true_depth(2)
    assert depth is not None
    assert depth.dtype == np.float32
    assert np.isnan(depth[0, :2]).all()
    np.testing.assert_allclose(depth[1:], depth_mm(2)[1:] / 1000, rtol=1e-6)


def moved_slowly(stored: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Move depth of 640x480 to the colour camera pixel by pixel, as SimpleRecon's script says."""
    moved = np.full(stored.shape, np.inf)
    for row, column in zip(*np.nonzero((stored > 0) & (stored < 65535)), strict=True):
        z = float(stored[row, column]) / 1000
        point = np.array([(column + 0.5 - 320) / 585 * z, (row + 0.5 - 240) / 585 * z, z, 1.0])
        x, y, z, _ = CAM_FROM_DEPTH_CAM @ point
        u, v = round(x / z * 525 + 320), round(y / z * 525 + 240)
        if 0 <= u < 640 and 0 <= v < 480:
            moved[v, u] = min(moved[v, u], z)
    return np.where(np.isfinite(moved), moved, np.nan)


def test_depth_is_moved_to_the_colour_camera_as_published_evaluations_do(tmp_path: Path) -> None:
    stored = np.zeros((480, 640), np.uint16)
    rng = np.random.default_rng(0)
    stored[100:160, 200:280] = rng.integers(800, 4000, (60, 80))
    stored[300:, 560:] = 1500  # what leaves the image, and what hides
    stored[310:330, 565:580] = 65535
    write_png(tmp_path / "frame-000000.color.png", textured(0, 480, 640))
    write_png(tmp_path / "frame-000000.depth.png", stored)
    depth = SevenScenes(tmp_path).true_depth(0)
    assert depth is not None
    expected = moved_slowly(stored)
    assert 10_000 < np.isfinite(expected).sum() < np.count_nonzero(stored)
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


def test_frames_that_were_left_out_leave_a_gap_in_time_only(tmp_path: Path) -> None:
    dataset = SevenScenes(write_sequence(tmp_path, (10, 12, 20), ".depth.proj.png"))
    assert [frame.index for frame in dataset.frames()] == [0, 1, 2]
    assert [round(frame.time_s * 30) for frame in dataset.frames()] == [10, 12, 20]
    assert dataset.info.truth is not None
    np.testing.assert_allclose(dataset.info.truth.world_from_cam[2], pose(20), atol=1e-12)
    depth = dataset.true_depth(2)
    assert depth is not None
    np.testing.assert_allclose(depth[1:], depth_mm(20)[1:] / 1000, rtol=1e-6)


@pytest.mark.parametrize("fault", ["nan", "sheared", "mirrored", "missing"])
def test_a_frame_whose_tracking_was_lost_has_no_true_pose(tmp_path: Path, fault: str) -> None:
    write_sequence(tmp_path)
    spoiled = {
        "nan": np.full((4, 4), np.nan),
        "sheared": np.triu(np.ones((4, 4))),
        "mirrored": np.diag([1.0, 1, -1, 1]),
    }
    path = tmp_path / "frame-000001.pose.txt"
    path.unlink() if fault == "missing" else np.savetxt(path, spoiled[fault])
    truth = SevenScenes(tmp_path).info.truth
    assert truth is not None
    assert list(truth.frames) == [0, 2, 3]
    np.testing.assert_allclose(truth.world_from_cam[1], pose(2), atol=1e-12)


def test_without_poses_and_depth_there_is_no_truth(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    for path in [*tmp_path.glob("*.pose.txt"), *tmp_path.glob("*.depth.png")]:
        path.unlink()
    dataset = SevenScenes(tmp_path)
    assert dataset.info.truth is None
    assert dataset.true_depth(0) is None


FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "the scene instead of a sequence": (
        lambda folder: (
            [path.rename(folder.with_name(path.name)) for path in folder.glob("*.c*")]
            + [(folder / "seq-02" / "images").mkdir(parents=True)]
        ),  # type: ignore[func-returns-value]
        r"no images such as frame-000000.color.png in .*\(folders there: seq-02\)",
    ),
    "a pose of three rows": (
        lambda folder: np.savetxt(folder / "frame-000002.pose.txt", np.eye(4)[:3]),
        "frame-000002.pose.txt must hold 4x4 numbers, got 12",
    ),
    "a pose of words": (
        lambda folder: (folder / "frame-000002.pose.txt").write_text("lost"),
        "cannot read .*frame-000002.pose.txt",
    ),
    "an image of another size": (
        lambda folder: write_png(folder / "frame-000003.color.png", textured(0, 30, 60)),
        "frame-000003.color.png is 60x30; unpack",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_sequence_is_refused_with_its_reason(tmp_path: Path, fault: str) -> None:
    write_sequence(tmp_path)
    spoil, message = FAULTS[fault]
    spoil(tmp_path)
    with pytest.raises(DatasetError, match=message) as caught:
        SevenScenes(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fault", ["cut", "8 bits", "another size"])
def test_a_broken_depth_map_is_refused_by_name(tmp_path: Path, fault: str) -> None:
    path = write_sequence(tmp_path) / "frame-000001.depth.png"
    dataset = SevenScenes(tmp_path)
    if fault == "cut":
        cut_file(path, 0.01)
    else:
        write_png(path, textured(0)[..., 0] if fault == "8 bits" else depth_mm(0)[:, :30])
    with pytest.raises(
        DatasetError, match=r"frame-000001.depth.png is no 16-bit grey PNG of 64x36"
    ):
        dataset.true_depth(1)
    assert dataset.true_depth(0) is not None


def test_the_command_line_refuses_a_missing_folder_in_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["7scenes", str(tmp_path / "none")])
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("laser-slam: no folder ")


HAS_NO_DATA = "LASER_SLAM_DATA" not in os.environ


@pytest.mark.skipif(HAS_NO_DATA, reason="set LASER_SLAM_DATA to real data")
def test_real_images_agree_with_depth_that_was_moved_more_than_with_depth_as_it_is() -> None:
    """Triangulate what two images share by the true poses, and ask both what lies there."""
    folder = Path(os.environ["LASER_SLAM_DATA"]) / "7scenes" / "kitchen" / "seq-01"
    dataset = SevenScenes(folder)
    info, K = dataset.info, dataset.info.intrinsics
    assert K is not None
    assert info.truth is not None
    ratios = []
    for first in range(0, 180, 24):
        pixels, others = shared_points(*(read_image(info.files[at]) for at in (first, first + 12)))
        poses = info.truth.world_from_cam[[first, first + 12]]
        second_from_first = (np.linalg.inv(poses[1]) @ poses[0])[:3]
        points = cv2.triangulatePoints(K @ np.eye(4)[:3], K @ second_from_first, pixels, others)
        z = points[2] / points[3]
        good = (z > 0.3) & (z < 6) & (z < 25 * np.linalg.norm(second_from_first[:, 3]))
        x, y = np.rint(pixels[:, good]).astype(int)
        as_it_is = read_depth(info.files[first].with_name(f"frame-{first:06d}.depth.png"),
                              info.size, 1000, "")  # fmt: skip
        moved = dataset.true_depth(first)
        assert moved is not None
        ratios.append(np.log([depth[y, x] / z[good] for depth in (moved, as_it_is)]))
    both = np.concatenate(ratios, axis=1)
    both = both[:, np.isfinite(both).all(axis=0)]
    found = np.median(np.abs(both), axis=1)
    assert both.shape[1] > 200
    assert found[0] < 0.8 * found[1]


def shared_points(first: Image | None, second: Image | None) -> NDArray[np.float64]:
    """Return (2, 2, N) pixels of points that both images show."""
    finder = cv2.SIFT_create(1500)
    (keys, words), (others, theirs) = (finder.detectAndCompute(image, None) for image in
                                       (first, second))  # fmt: skip
    pairs = cv2.BFMatcher().knnMatch(words, theirs, 2)
    good = [best for best, next_best in pairs if best.distance < 0.75 * next_best.distance]
    return np.array([[keys[m.queryIdx].pt for m in good], [others[m.trainIdx].pt for m in good]],
                    np.float64).transpose(0, 2, 1)  # fmt: skip


@pytest.mark.skipif(HAS_NO_DATA, reason="set LASER_SLAM_DATA to real data")
def test_real_depth_warped_by_real_poses_meets_itself() -> None:
    """Which shows that poses are camera-to-world, depth is in metres and the intrinsics fit."""
    folder = Path(os.environ["LASER_SLAM_DATA"]) / "7scenes" / "kitchen" / "seq-01"
    dataset = SevenScenes(folder)
    info = dataset.info
    assert info.truth is not None
    assert info.intrinsics is not None
    first, second = dataset.true_depth(0), dataset.true_depth(15)
    assert first is not None
    assert second is not None
    second_from_first = np.linalg.inv(info.truth.world_from_cam[15]) @ info.truth.world_from_cam[0]
    points = unproject(first, info.intrinsics)[::4, ::4].reshape(-1, 3)
    moved = points[np.isfinite(points[:, 2])] @ second_from_first[:3, :3].T
    moved += second_from_first[:3, 3]
    pixels = np.rint(np.nan_to_num(project(moved, info.intrinsics), nan=-1)).astype(int)
    inside = ((pixels >= 0) & (pixels < [640, 480])).all(axis=1)
    seen = second[pixels[inside, 1], pixels[inside, 0]] / moved[inside, 2]
    assert inside.mean() > 0.5
    assert abs(np.log(seen[np.isfinite(seen)])).mean() < 0.1
    assert np.nanmedian(abs(np.log(seen))) < 0.01
    image = next(dataset.frames()).image
    assert image is not None
    assert cv2.Laplacian(image, cv2.CV_64F).var() > 10
