"""A scene of known content, written as the published data sets lay their sequences out."""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from corridor import SIZE, true_intrinsics, true_pose
from corridor import view as render
from image_files import write_png
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from laser_slam.datasets.base import Dataset
from laser_slam.datasets.bonn import Bonn
from laser_slam.datasets.kitti_depth import KittiDepth
from laser_slam.datasets.nrgbd import Nrgbd
from laser_slam.datasets.scannet import ScanNet
from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.datasets.sintel import Sintel
from laser_slam.datasets.tum_rgbd import TumRgbd
from laser_slam.datasets.waymo import Waymo
from laser_slam.types import Image

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

T0 = 1311868164.363181  # seconds of the epoch, as TUM's times are
DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0002_sync"
SEGMENT = "segment-183829460855609442_430_000_450_000_with_camera_labels.tfrecord"
view = cache(render)
FIRST_DEPTH = 5  # KITTI: the first five images of a drive have none


@dataclass(frozen=True)
class Scene:
    """What the sequences show: image (H, W, 3) and depth (H, W) of each frame, and its camera.

    Frames below 0 may be asked for their images. Depth is z in metres; NaN: unknown.
    """

    image: Callable[[int], Image]
    depth: Callable[[int], Depth]
    pose: Callable[[int], Array]
    intrinsics: Array
    size: tuple[int, int]


CORRIDOR = Scene(
    lambda frame: view(frame)[0],
    lambda frame: view(frame)[1],
    true_pose,
    true_intrinsics(),
    SIZE,
)


def counts(frame: int, units_per_m: float, scene: Scene = CORRIDOR) -> NDArray[np.uint16]:
    """Return the depth as 16-bit numbers, 0 where it is unknown or they do not reach."""
    stored = np.rint(scene.depth(frame).astype(np.float64) * units_per_m)
    return np.where(stored <= 65535, stored, 0).astype(np.uint16)


def write_jpg(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    sharp = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR]
    full_color = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    assert cv2.imwrite(str(path), image[..., ::-1], [*sharp, full_color])


def write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def write_bytes(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def write_matrix(path: Path, matrix: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix, fmt="%.12g")


def write_exr(path: Path, pixels: NDArray[np.float32], top: int = 0) -> None:
    """Write one channel of float32 in blocks of 16 lines, deflated where that shrinks them.

    The first line has number ``top``.
    """
    height, width = pixels.shape
    box = struct.pack("<4i", 0, top, width - 1, top + height - 1)
    attributes = {
        ("channels", "chlist"): b"Y\0" + struct.pack("<iB3xii", 2, 0, 1, 1) + b"\0",
        ("compression", "compression"): b"\3",
        ("dataWindow", "box2i"): box,
        ("displayWindow", "box2i"): box,
        ("lineOrder", "lineOrder"): b"\0",
        ("pixelAspectRatio", "float"): struct.pack("<f", 1),
        ("screenWindowCenter", "v2f"): bytes(8),
        ("screenWindowWidth", "float"): struct.pack("<f", 1),
    }
    data = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    for (name, kind), value in attributes.items():
        data += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    blocks = [
        struct.pack("<2i", top + row, len(packed)) + packed
        for row in range(0, height, 16)
        for packed in [_packed(pixels[row : row + 16].astype("<f4").tobytes())]
    ]
    ends = np.cumsum([len(data) + 1 + 8 * len(blocks), *map(len, blocks)])
    write_bytes(path, data + b"\0" + struct.pack(f"<{len(blocks)}q", *ends[:-1]) + b"".join(blocks))


def _packed(raw: bytes) -> bytes:
    mixed = np.frombuffer(raw[0::2] + raw[1::2], np.uint8)
    steps = np.diff(mixed, prepend=np.uint8(0)).astype(np.uint8)
    steps[1:] += np.uint8(128)
    packed = zlib.compress(steps.tobytes())
    return packed if len(packed) < len(raw) else raw


def tum(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write rgb, depth and a trajectory, each with a clock of its own and rows between."""
    rgb, depth, truth = [], [], []
    for frame in range(num):
        time = T0 + frame / 30
        write_png(folder / "rgb" / f"{time:.6f}.png", scene.image(frame))
        write_png(folder / "depth" / f"{time + 0.012:.6f}.png", counts(frame, 5000, scene))
        rgb.append(f"{time:.6f} rgb/{time:.6f}.png")
        depth.append(f"{time + 0.012:.6f} depth/{time + 0.012:.6f}.png")
        pose = scene.pose(frame)
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        truth.append(f"{time + 0.003:.6f} " + " ".join(f"{number:.9f}" for number in numbers))
        truth.append(f"{time + 0.016:.6f} 9 9 9 0 0 0 1")  # of no image
    for name, lines in {"rgb": rgb, "depth": depth, "groundtruth": truth}.items():
        write_text(folder / f"{name}.txt", "\n".join(["# title", "# file: x.bag", *lines]) + "\n")


def bonn(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write what TUM has, with the poses of the markers."""
    turned = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    published = np.array(
        [[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]]
    )
    markers_from_cam = np.eye(4)
    markers_from_cam[:3, :3] = Rotation.from_matrix(
        published / np.cbrt(np.linalg.det(published))
    ).as_matrix()
    markers_from_cam[:3, 3] = [0.0113, -0.0098, 0.0111]
    back = np.linalg.inv(turned @ markers_from_cam)
    markers = replace(scene, pose=lambda frame: np.asarray(turned @ scene.pose(frame) @ back))
    tum(folder, num, markers)


def scannet(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write what ScanNet's Python reader exports, depth at half the size."""
    for frame in range(num):
        write_jpg(folder / "color" / f"{frame}.jpg", scene.image(frame))
        write_png(folder / "depth" / f"{frame}.png", counts(frame, 1000, scene)[1::2, 1::2])
        write_matrix(folder / "pose" / f"{frame}.txt", scene.pose(frame))
    write_matrix(folder / "intrinsic" / "intrinsic_color.txt", _four(scene.intrinsics))
    write_matrix(folder / "intrinsic" / "intrinsic_depth.txt", _four(_of_half(scene)))


def _of_half(scene: Scene) -> Array:
    """Return the intrinsics of a camera that has every second pixel, from the second on."""
    halved = scene.intrinsics.copy()
    halved[:2] /= 2
    halved[:2, 2] -= 0.5
    return halved


def scannet_by_cpp(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write what ScanNet's C++ reader exports."""
    for frame in range(num):
        stem = folder / f"frame-{frame:06d}"
        write_jpg(stem.with_suffix(".color.jpg"), scene.image(frame))
        stored = counts(frame, 1000, scene)[1::2, 1::2]
        head = f"P5\n# data values are 16-bit each; depth shift is 1000\n{stored.shape[1]} "
        head += f"{stored.shape[0]}\n65535\n"
        write_bytes(stem.with_suffix(".depth.pgm"), head.encode() + stored.astype(">u2").tobytes())
        write_matrix(stem.with_suffix(".pose.txt"), scene.pose(frame))
    lines = ["m_versionNumber = 4", "m_depthShift = 1000"]
    for camera, intrinsics in {"Color": scene.intrinsics, "Depth": _of_half(scene)}.items():
        numbers = " ".join(f"{number:.9g}" for number in _four(intrinsics).ravel())
        lines += [f"m_calibration{camera}Intrinsic = {numbers} "]
    write_text(folder / "_info.txt", "\n".join([*lines, "m_frames.size = 9", ""]))


def _four(intrinsics: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = intrinsics
    return matrix


def seven_scenes(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write images, poses, and depth as it is after it was moved to the colour camera."""
    for frame in range(num):
        stem = folder / f"frame-{frame:06d}"
        write_png(stem.with_suffix(".color.png"), scene.image(frame))
        write_png(stem.with_suffix(".depth.png"), counts(frame, 1000, scene)[:, ::-1])
        write_png(stem.with_suffix(".depth.proj.png"), counts(frame, 1000, scene))
        write_matrix(stem.with_suffix(".pose.txt"), scene.pose(frame))


def nrgbd(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    poses = []
    for frame in range(num):
        write_png(folder / "images" / f"img{frame}.png", scene.image(frame))
        write_png(folder / "depth" / f"depth{frame}.png", counts(frame, 1000, scene))
        poses.append(scene.pose(frame) * [1, -1, -1, 1])  # columns: x, y, z, place
    write_matrix(folder / "poses.txt", np.concatenate(poses))
    write_text(folder / "focal.txt", f"{scene.intrinsics[0, 0]}\n")


def sintel(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    training, name = folder.parent.parent, folder.name
    tag = struct.pack("<f", 202021.25)
    for frame in range(num):
        stem = f"frame_{frame + 1:04d}"
        write_png(folder / f"{stem}.png", scene.image(frame))
        head = tag + struct.pack("<2i", scene.size[1], scene.size[0])
        depth = np.nan_to_num(scene.depth(frame), nan=1e10).astype("<f4")
        write_bytes(training / "depth" / name / f"{stem}.dpt", head + depth.tobytes())
        cam_from_world = np.linalg.inv(scene.pose(frame))[:3]
        camera = scene.intrinsics.tobytes() + np.ascontiguousarray(cam_from_world).tobytes()
        write_bytes(training / "camdata_left" / name / f"{stem}.cam", tag + camera)


def waymo(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    for frame in range(num):
        stem = folder / f"{frame:05d}_1"
        write_jpg(stem.with_suffix(".jpg"), scene.image(frame))
        write_jpg(folder / f"{frame:05d}_2.jpg", scene.image(frame)[:, ::-1])
        write_exr(stem.with_suffix(".exr"), scanned(frame, scene))
        np.savez(
            stem.with_suffix(".npz"),
            intrinsics=scene.intrinsics,
            cam2world=scene.pose(frame),
            distortion=np.zeros(5),
        )


def scanned(frame: int, scene: Scene = CORRIDOR) -> Depth:
    """Return the depth where a LiDAR would hit, 0 elsewhere."""
    hits = np.random.default_rng(frame).random(scene.size) < 0.2
    return np.where(hits, np.nan_to_num(scene.depth(frame)), 0).astype(np.float32)


def kitti_depth(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write a drive of which the first and last five images have no depth."""
    day = folder.parent.parent / "raw" / folder.name[:10]
    images = day / folder.name / "image_02" / "data"
    for number in range(num + 2 * FIRST_DEPTH):
        write_png(images / f"{number:010d}.png", scene.image(number - FIRST_DEPTH))
    for frame in range(num):
        path = folder / "proj_depth" / "groundtruth" / "image_02"
        write_png(path / f"{frame + FIRST_DEPTH:010d}.png", counts(frame, 256, scene))
    row = np.column_stack([scene.intrinsics, [44.9, 0.2, 0.003]]).ravel()
    numbers = " ".join(f"{number:.9e}" for number in row)
    write_text(day / "calib_cam_to_cam.txt", f"calib_time: 09-Jan-2012\nP_rect_02: {numbers}\n")


def kitti_odometry(folder: Path, num: int, scene: Scene = CORRIDOR) -> None:
    """Write ``sequences/SEQ``; its poses go where the official ones are."""
    for frame in range(num):
        write_png(folder / "image_2" / f"{frame:06d}.png", scene.image(frame))
    rows = [np.column_stack([scene.intrinsics, [shift, 0, 0]]) for shift in (0, -386, 45, -335)]
    lines = [" ".join(f"{number:.12e}" for number in row.ravel()) for row in rows]
    calibration = "".join(f"P{camera}: {line}\n" for camera, line in enumerate(lines))
    write_text(folder / "calib.txt", calibration)
    write_text(folder / "times.txt", "".join(f"{frame / 10:.6e}\n" for frame in range(num)))
    path = folder.parent.parent / "poses" / f"{folder.name}.txt"
    write_matrix(path, np.array([scene.pose(frame)[:3].ravel() for frame in range(num)]))


def choose_tum(folder: Path, step: int, num: int) -> Path:
    """Copy images and poses as MonST3R's ``prepare_tum.py`` does; give the folder of the images."""
    lists = {}
    for name in ("rgb", "groundtruth"):
        lines = (folder / f"{name}.txt").read_text().splitlines()
        lists[name] = [line for line in lines if line[0] != "#"]
    posed = lists["groundtruth"][::2]  # each second line is of no image
    chosen = list(zip(lists["rgb"], posed, strict=True))[::step][:num]
    for line, _ in chosen:
        _copy(folder / line.split()[1], folder / "rgb_90")
    write_text(folder / "groundtruth_90.txt", "".join(f"{pose}\n" for _, pose in chosen))
    return folder / "rgb_90"


def choose_bonn(folder: Path, first: int, num: int) -> Path:
    """Copy images and depth by rank as MonST3R's ``prepare_bonn.py`` does, and poses by rank."""
    for kind in ("rgb", "depth"):
        for path in sorted((folder / kind).iterdir())[first : first + num]:
            _copy(path, folder / f"{kind}_110")
    rows = np.loadtxt(folder / "groundtruth.txt")[first : first + num]
    np.savetxt(folder / "groundtruth_110.txt", rows)
    return folder / "rgb_110"


def choose_scannet(folder: Path, step: int, num: int) -> Path:
    """Copy and number anew as MonST3R's ``prepare_scannet.py`` does."""
    poses = []
    for index in range(num):
        number = index * step
        for kind, suffix in (("color", "jpg"), ("depth", "png")):
            source = folder / kind / f"{number}.{suffix}"
            _copy(source, folder / f"{kind}_90", f"frame_{index:04d}.{suffix}")
        poses.append(np.loadtxt(folder / "pose" / f"{number}.txt").ravel())
    lines = (" ".join(map(str, pose.tolist())) for pose in poses)
    write_text(folder / "pose_90.txt", "".join(f"{line}\n" for line in lines))
    return folder / "color_90"


def choose_kitti_depth(folder: Path, num: int) -> Path:
    """Copy depth and images as MonST3R's ``prepare_kitti.py`` does."""
    root = folder.parent.parent / "depth_selection" / "val_selection_cropped"
    raw = folder.parent.parent / "raw" / folder.name[:10] / folder.name / "image_02" / "data"
    depths = sorted((folder / "proj_depth" / "groundtruth" / "image_02").iterdir())[:num]
    for path in depths:
        _copy(path, root / "groundtruth_depth_gathered" / f"{folder.name}_02")
        _copy(raw / path.name, root / "image_gathered" / f"{folder.name}_02")
    return root / "image_gathered" / f"{folder.name}_02"


def _copy(path: Path, folder: Path, name: str | None = None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(path, folder / (name or path.name))


@dataclass(frozen=True)
class Layout:
    """How one data set is written and opened, and what is known of what comes out."""

    write: Callable[[Path, int, Scene], None]
    open: Callable[[Path], Dataset]
    place: str
    name: str
    fps: float
    unit_m: float = 1e-6  # step of its depth numbers
    reach_m: float = np.inf
    has_poses: bool = True
    has_own_lens: bool = True
    is_lossy: bool = False


LAYOUTS = {
    "tum-rgbd": Layout(
        tum,
        TumRgbd,
        "rgbd_dataset_freiburg3_corridor",
        "tum-freiburg3_corridor",
        30,
        1 / 5000,
        13.107,
        has_own_lens=False,
    ),
    "bonn": Layout(
        bonn,
        Bonn,
        "rgbd_bonn_corridor",
        "bonn-corridor",
        30,
        1 / 5000,
        13.107,
        has_own_lens=False,
    ),
    "scannet": Layout(
        scannet, ScanNet, "scene0707_00", "scannet-scene0707_00", 30, 1e-3, is_lossy=True
    ),
    "7scenes": Layout(
        seven_scenes,
        SevenScenes,
        "redkitchen/seq-03",
        "7scenes-redkitchen-seq-03",
        30,
        1e-3,
        65.5,
        has_own_lens=False,
    ),
    "nrgbd": Layout(nrgbd, Nrgbd, "corridor", "nrgbd-corridor", 30, 1e-3),
    "sintel": Layout(sintel, Sintel, "training/final/alley_2", "sintel-final-alley_2", 24),
    "waymo": Layout(
        waymo,
        Waymo,
        SEGMENT,
        "waymo-183829460855609442_430_000_450_000-front",
        10,
        is_lossy=True,
    ),
    "kitti-depth": Layout(
        kitti_depth,
        KittiDepth,
        f"val/{DRIVE}",
        "kitti-depth-2011_09_26_drive_0002",
        10,
        1 / 256,
        has_poses=False,
    ),
}


def write_layout(key: str, root: Path, num: int) -> Path:
    """Write a miniature and return the folder that a user would give."""
    layout = LAYOUTS[key]
    folder = root / layout.place
    layout.write(folder, num, CORRIDOR)
    return folder


def open_layout(key: str, root: Path, num: int) -> Dataset:
    return LAYOUTS[key].open(write_layout(key, root, num))
