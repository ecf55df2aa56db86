"""KITTI sequences are read whole, and a faulty one is refused in one line."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from image_files import HEIGHT, WIDTH, textured, write_folder, write_png

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.errors import DatasetError

CALIBRATION = "P0: 50 0 31 0 0 50 17 0 0 0 1 0\nP2: 60 0 32 6 0 60 18 0 0 0 1 0\n"


def write_kitti(root: Path, num: int = 5, camera: str = "image_2") -> Path:
    folder = root / "sequences" / "03"
    write_folder(folder / camera, num)
    (folder / "calib.txt").write_text(CALIBRATION)
    (folder / "times.txt").write_text("".join(f"{0.1 * index:e}\n" for index in range(num)))
    (root / "poses").mkdir()
    lines = [f"1 0 0 0 0 1 0 0 0 0 1 {0.5 * index}\n" for index in range(num)]
    (root / "poses" / "03.txt").write_text("".join(lines))
    return root


@pytest.mark.parametrize("above", [".", "..", "sequences"])
def test_kitti_is_found_from_its_root_from_above_and_from_sequences(
    tmp_path: Path, above: str
) -> None:
    root = write_kitti(tmp_path / "dataset")
    assert KittiOdometry((root / above).resolve(), "3").info.name == "kitti-03"


def test_kitti_frames_come_in_order_with_times_calibration_and_poses(tmp_path: Path) -> None:
    dataset = KittiOdometry(write_kitti(tmp_path), "03")
    info, frames = dataset.info, list(dataset.frames())
    assert (info.size, info.num_frames) == ((HEIGHT, WIDTH), 5)
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([frame.time_s for frame in frames], 0.1 * np.arange(5))
    np.testing.assert_array_equal(frames[3].image, textured(3))
    np.testing.assert_array_equal(info.intrinsics, intrinsics_matrix(60, 60, 32, 18))
    assert info.intrinsics_source == "calib.txt, row P2"
    assert info.truth is not None
    np.testing.assert_allclose(info.truth.world_from_cam[:, 2, 3], 0.5 * np.arange(5))


def test_kitti_reads_the_grey_camera_with_its_own_calibration(tmp_path: Path) -> None:
    info = KittiOdometry(write_kitti(tmp_path, camera="image_0"), "03").info
    assert info.intrinsics is not None
    assert info.intrinsics[0, 0] == 50


def test_kitti_without_poses_has_no_truth(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "poses" / "03.txt").unlink()
    assert KittiOdometry(root, "03").info.truth is None


def test_kitti_depth_is_metres_with_unknown_as_nan(tmp_path: Path) -> None:
    dataset = KittiOdometry(write_kitti(tmp_path), "03")
    stored = np.full((HEIGHT, WIDTH), 2 * 256 + 128, np.uint16)
    stored[0, 0] = 0
    write_png(tmp_path / "sequences/03/depth/000002.png", stored)
    depth = dataset.true_depth(2)
    assert depth is not None
    assert np.isnan(depth[0, 0])
    assert depth[1, 1] == 2.5
    assert dataset.true_depth(1) is None


def test_a_depth_map_of_8_bits_is_refused(tmp_path: Path) -> None:
    dataset = KittiOdometry(write_kitti(tmp_path), "03")
    write_png(tmp_path / "sequences/03/depth/000002.png", textured(0))
    with pytest.raises(DatasetError, match="no 16-bit grey PNG of 64x36"):
        dataset.true_depth(2)


def test_whole_pose_files_serve_a_sequence_that_was_cut_with_its_times(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    poses = root / "poses/03.txt"
    poses.write_text(poses.read_text() * 3)
    truth = KittiOdometry(root, "03").info.truth
    assert truth is not None
    assert len(truth.frames) == 5


def edit(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / name
        path.write_text(change(path.read_text()))

    return spoil


def remove(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


SEQUENCE = "sequences/03"
KITTI_FAULTS = {
    "too few times": (edit(f"{SEQUENCE}/times.txt", lambda t: t[:-26]), "has 3 times for 5 images"),
    "too many times": (
        edit(f"{SEQUENCE}/times.txt", lambda t: t + "9\n"),
        "has 6 times for 5 images; .*or cut times.txt to 5 lines",
    ),
    "times that fall": (
        edit(f"{SEQUENCE}/times.txt", lambda t: t.replace("3.0", "1.0")),
        "do not rise at line 4: 0.2 s, then 0.1 s",
    ),
    "times that are words": (
        edit(f"{SEQUENCE}/times.txt", lambda t: t.replace("3.0", "x")),
        "line 4 of .*times.txt must hold 1 number;",
    ),
    "no times": (
        remove(f"{SEQUENCE}/times.txt"),
        "cannot read .*times.txt .*; unpack KITTI's data_odometry_calib.zip",
    ),
    "no calibration": (
        remove(f"{SEQUENCE}/calib.txt"),
        "cannot read .*calib.txt .*; unpack KITTI's data_odometry_calib.zip",
    ),
    "no row of the camera": (
        edit(f"{SEQUENCE}/calib.txt", lambda t: t.splitlines()[0]),
        "has no row P2, which belongs to image_2",
    ),
    "half a row": (
        edit(f"{SEQUENCE}/calib.txt", lambda t: t.replace("18 0 0 0 1 0", "18")),
        "row P2 of .* must hold 12 numbers",
    ),
    "a calibration for other images": (
        edit(f"{SEQUENCE}/calib.txt", lambda t: t.replace("32", "600")),
        "row P2: the principal point cx=600, cy=18 is outside the images of 64x36",
    ),
    "no focal length": (
        edit(f"{SEQUENCE}/calib.txt", lambda t: t.replace("60", "0")),
        "focal lengths must be positive",
    ),
    "too few poses": (
        edit("poses/03.txt", lambda t: "\n".join(t.splitlines()[:4])),
        "has 4 poses for 5 images; .* remove the file to run without",
    ),
    "a broken pose line": (
        edit("poses/03.txt", lambda t: t[:-9]),
        "line 5 of .*03.txt must hold 12 numbers",
    ),
    "a pose that is none": (
        edit("poses/03.txt", lambda t: t.replace("1 0 0 0 0 1", "2 0 0 0 0 1", 1)),
        "line 1 of .* is no pose",
    ),
    "a missing image": (remove(f"{SEQUENCE}/image_2/000002.png"), "image 000002 is missing"),
    "an image of another size": (
        lambda root: write_png(root / SEQUENCE / "image_2/000003.png", textured(0, 30, 60)),
        "000000.png is 64x36, 000003.png is 60x30",
    ),
}


@pytest.mark.parametrize("fault", KITTI_FAULTS)
def test_a_faulty_kitti_sequence_is_refused_with_its_reason(tmp_path: Path, fault: str) -> None:
    root = write_kitti(tmp_path)
    spoil, message = KITTI_FAULTS[fault]
    spoil(root)
    with pytest.raises(DatasetError, match=message) as caught:
        KittiOdometry(root, "03")
    assert "\n" not in str(caught.value)


def test_a_wrong_kitti_root_says_what_to_pass(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no folder 'sequences' in .*LASER_SLAM_KITTI"):
        KittiOdometry(tmp_path, "00")
    root = write_kitti(tmp_path)
    with pytest.raises(DatasetError, match=r"no KITTI sequence 07 in .*\(there: 03\)"):
        KittiOdometry(root, "7")
    with pytest.raises(DatasetError, match=r"no images of KITTI sequence 03 in .*image_1; pass"):
        KittiOdometry(root, "3", camera="image_1")


@pytest.mark.skipif("LASER_SLAM_DATA" not in os.environ, reason="set LASER_SLAM_DATA to real data")
def test_real_kitti_is_read_with_times_poses_and_calibration() -> None:
    dataset = KittiOdometry(Path(os.environ["LASER_SLAM_DATA"]) / "kitti_odometry", "6")
    info = dataset.info
    assert info.intrinsics is not None
    assert info.truth is not None
    assert 650 < info.intrinsics[0, 0] < 750
    assert sum(frame.image is not None for frame in dataset.frames()) == len(info.truth.frames)
