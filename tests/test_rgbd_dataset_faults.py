"""What is wrong with a published data set on disk is said in one line that names the file."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from image_files import cut_file, textured, write_png
from layouts import LAYOUTS, write_exr, write_layout

from laser_slam.errors import DatasetError

NUM = 4

Spoil = Callable[[Path], object]


def remove(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).unlink()

    return spoil


def replace_line(name: str, number: int, line: str) -> Spoil:
    def spoil(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[number - 1] = line
        (folder / name).write_text("\n".join(lines))

    return spoil


def shift_times(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        rows = (row.split() for row in (folder / name).read_text().splitlines()[2:])
        lines = [f"{float(row[0]) + 100} {' '.join(row[1:])}" for row in rows]
        (folder / name).write_text("\n".join(lines))

    return spoil


def spoil_camera(path: Path, **changed: np.ndarray) -> None:
    with np.load(path) as stored:
        content = {**stored, **changed}
    np.savez(path, **content)


def beside(folder: Path, *parts: str) -> Path:
    """Return a file of Sintel's truth, which lies beside the images."""
    return folder.parent.parent.joinpath(*parts)


FAULTS: dict[str, tuple[str, Spoil, str]] = {
    "tum: no list of images": (
        "tum-rgbd",
        remove("rgb.txt"),
        "no rgb.txt in .*; give the folder of one sequence",
    ),
    "tum: an empty list": (
        "tum-rgbd",
        lambda folder: (folder / "depth.txt").write_text("# depth maps\n"),
        "depth.txt is empty",
    ),
    "tum: a time of words": (
        "tum-rgbd",
        replace_line("rgb.txt", 4, "now rgb/1.png"),
        "line 4 of .*rgb.txt must hold a time and 1 value;",
    ),
    "tum: half a pose": (
        "tum-rgbd",
        replace_line("groundtruth.txt", 5, "1311868164.38 1 2 3"),
        "line 5 of .*groundtruth.txt must hold a time and 7 values;",
    ),
    "tum: a pose of words": (
        "tum-rgbd",
        replace_line("groundtruth.txt", 5, "1311868164.399514 a b c d e f g"),
        "line 5 of .*groundtruth.txt holds no pose",
    ),
    "tum: times that fall": (
        "tum-rgbd",
        replace_line("rgb.txt", 4, "1.0 rgb/1.png"),
        "the times in .*rgb.txt do not rise at line 4",
    ),
    "tum: a trajectory of another day": (
        "tum-rgbd",
        shift_times("groundtruth.txt"),
        "no time in .*groundtruth.txt is within 20 ms of an image",
    ),
    "tum: depth of another day": (
        "tum-rgbd",
        shift_times("depth.txt"),
        "no time in .*depth.txt is within 20 ms of an image",
    ),
    "tum: the first image is empty": (
        "tum-rgbd",
        lambda folder: cut_file(min((folder / "rgb").iterdir()), 0.0),
        "the first image of .* cannot be read",
    ),
    "bonn: images of two sizes": (
        "bonn",
        lambda folder: write_png(max((folder / "rgb").iterdir()), textured(0)),
        "images of different sizes in .*; unpack the sequence again",
    ),
    "scannet: no images": (
        "scannet",
        lambda folder: shutil.rmtree(folder / "color"),
        "no folder .*color; give the folder of one exported scene",
    ),
    "scannet: an empty folder": (
        "scannet",
        lambda folder: [path.rename(folder / path.name) for path in (folder / "color").iterdir()],
        "no images such as 0.jpg in .*color; give the folder of one exported scene",
    ),
    "scannet: a pose of three rows": (
        "scannet",
        lambda folder: np.savetxt(folder / "pose" / "1.txt", np.eye(4)[:3]),
        "pose/1.txt must hold 4x4 numbers, got 12; export",
    ),
    "scannet: intrinsics of a larger image": (
        "scannet",
        lambda folder: np.savetxt(
            folder / "intrinsic" / "intrinsic_color.txt",
            [[1170, 0, 648, 0], [0, 1170, 484, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        ),
        "intrinsic_color.txt: the principal point cx=648, cy=484 is outside the images",
    ),
    "nrgbd: fewer poses than images": (
        "nrgbd",
        lambda folder: np.savetxt(folder / "poses.txt", np.tile(np.eye(4), (3, 1))),
        "poses.txt has 12 lines for 4 images, 4 each",
    ),
    "nrgbd: a row of three": (
        "nrgbd",
        replace_line("poses.txt", 6, "1 0 0"),
        "line 6 of .*poses.txt must hold 4 numbers",
    ),
    "nrgbd: two focal lengths": (
        "nrgbd",
        lambda folder: (folder / "focal.txt").write_text("554 554"),
        "focal.txt must hold one number, the focal length",
    ),
    "sintel: the folder of all sequences": (
        "sintel",
        lambda folder: [path.rename(folder / f"x{path.name}") for path in folder.glob("*.png")],
        "no images such as frame_0001.png in .*; give a sequence such as training/final/alley_2",
    ),
    "sintel: a cut camera": (
        "sintel",
        lambda folder: cut_file(beside(folder, "camdata_left", folder.name, "frame_0002.cam")),
        "frame_0002.cam is no .cam file of MPI Sintel",
    ),
    "waymo: no camera": (
        "waymo",
        remove("00002_1.npz"),
        "cannot read the camera .*00002_1.npz .No such file",
    ),
    "waymo: a cut camera": (
        "waymo",
        lambda folder: cut_file(folder / "00002_1.npz"),
        "cannot read the camera .*00002_1.npz",
    ),
    "waymo: a camera of another shape": (
        "waymo",
        lambda folder: spoil_camera(folder / "00002_1.npz", cam2world=np.eye(3)),
        r"00002_1.npz must hold intrinsics \(3, 3\), cam2world \(4, 4\) and, if at all, distortion",
    ),
    "kitti: no depth": (
        "kitti-depth",
        lambda folder: shutil.rmtree(folder / "proj_depth"),
        "no depth maps in .*image_02; give a drive such as val/2011",
    ),
    "kitti: no raw images": (
        "kitti-depth",
        lambda folder: shutil.rmtree(beside(folder, "raw")),
        "no images of 2011_09_26_drive_0002_sync in .*; pass --raw, the folder that holds",
    ),
    "kitti: an image is missing": (
        "kitti-depth",
        lambda folder: next(beside(folder, "raw").rglob("0000000007.png")).unlink(),
        "1 of 4 depth maps have no image in .*, the first is 0000000007",
    ),
    "kitti: half a calibration": (
        "kitti-depth",
        lambda folder: next(beside(folder, "raw").rglob("calib*")).write_text("P_rect_02: 1 2"),
        "calib_cam_to_cam.txt has no row P_rect_02 of 12 numbers",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_sequence_is_refused_in_one_line(fault: str, tmp_path: Path) -> None:
    key, spoil, message = FAULTS[fault]
    folder = write_layout(key, tmp_path, NUM)
    spoil(folder)
    with pytest.raises(DatasetError, match=message) as caught:
        LAYOUTS[key].open(folder)
    assert "\n" not in str(caught.value)


def shrink_dpt(path: Path) -> None:
    path.write_bytes(struct.pack("<f2i", 202021.25, 64, 36) + bytes(4 * 64 * 36))


DEPTH_FAULTS: dict[str, tuple[str, str, Callable[[Path], object], str]] = {
    "tum: listed and not there": ("tum-rgbd", "*.png", Path.unlink, "no depth map .*; unpack"),
    "bonn: 8 bits": (
        "bonn",
        "*.png",
        lambda path: write_png(path, textured(0)[..., 0]),
        "is no 16-bit grey PNG of 128x72",
    ),
    "scannet: no image": ("scannet", "1.png", lambda path: path.write_text("x"), "is no image"),
    "nrgbd: another size": (
        "nrgbd",
        "depth1.png",
        lambda path: write_png(path, np.ones((36, 64), np.uint16)),
        "depth1.png is no 16-bit grey PNG of 128x72",
    ),
    "sintel: cut": ("sintel", "*2.dpt", cut_file, r"frame_0002.dpt is cut: \d+ bytes"),
    "sintel: another size": ("sintel", "*2.dpt", shrink_dpt, "is no .dpt file of 128x72 pixels"),
    "sintel: another file": (
        "sintel",
        "*2.dpt",
        lambda path: path.write_bytes(b"x"),
        "is no .dpt file of 128x72 pixels",
    ),
    "waymo: cut": ("waymo", "00001_1.exr", cut_file, "00001_1.exr is no OpenEXR image of one"),
    "waymo: another size": (
        "waymo",
        "00001_1.exr",
        lambda path: write_exr(path, np.ones((36, 64), np.float32)),
        "00001_1.exr is 64x36, the images are 128x72",
    ),
    "kitti: cut": ("kitti-depth", "*6.png", lambda path: cut_file(path, 0.05), "is no 16-bit grey"),
}


@pytest.mark.parametrize("fault", DEPTH_FAULTS)
def test_a_broken_depth_map_is_refused_by_its_name_and_spoils_no_other(
    fault: str, tmp_path: Path
) -> None:
    key, pattern, spoil, message = DEPTH_FAULTS[fault]
    folder = write_layout(key, tmp_path, NUM)
    found = [
        path
        for path in sorted(tmp_path.rglob(pattern))
        if "rgb" not in path.parts and "raw" not in path.parts
    ]
    path = found[1] if len(found) > 1 else found[0]
    dataset = LAYOUTS[key].open(folder)
    spoil(path)
    with pytest.raises(DatasetError, match=message) as caught:
        dataset.true_depth(1)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert dataset.true_depth(0) is not None


@pytest.mark.parametrize("key", LAYOUTS)
def test_an_unreadable_image_comes_as_none_and_the_others_as_they_are(
    key: str, tmp_path: Path
) -> None:
    dataset = LAYOUTS[key].open(write_layout(key, tmp_path, NUM))
    cut_file(dataset.info.files[2])
    frames = list(dataset.frames())
    assert [frame.image is None for frame in frames] == [False, False, True, False]


@pytest.mark.parametrize("key", [key for key in LAYOUTS if LAYOUTS[key].has_poses])
def test_without_truth_a_sequence_is_still_a_sequence(key: str, tmp_path: Path) -> None:
    folder = write_layout(key, tmp_path, NUM)
    truth = ["depth.txt", "groundtruth.txt", "poses.txt", "focal.txt"]
    loose = (path for end in ("exr", "depth*.png", "pose.txt") for path in folder.glob(f"*.{end}"))
    for path in [*(folder / name for name in truth), *loose]:
        path.unlink(missing_ok=True)
    for name in ("depth", "pose", "intrinsic"):
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in ("depth", "camdata_left"):
        shutil.rmtree(beside(folder, name), ignore_errors=True)
    dataset = LAYOUTS[key].open(folder)
    assert dataset.true_depth(0) is None
    assert (dataset.info.truth is None) == (key != "waymo")
    if key in ("scannet", "nrgbd", "sintel"):
        assert dataset.info.intrinsics is None
        assert dataset.info.intrinsics_source.startswith("unknown: no ")
    assert len(list(dataset.frames())) == NUM
