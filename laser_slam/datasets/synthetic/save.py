"""Write a data set as KITTI odometry lays it out, with depth maps beside the images."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.base import Dataset
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo

DEPTH_STEPS_PER_M = 256.0  # KITTI's 16-bit depth; 0 is unknown


def save_kitti_layout(
    dataset: Dataset,
    root: Path,
    sequence: str,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write images, calibration, times, poses and depth under ``root``.

    ``sequences/<sequence>/{image_2, depth, calib.txt, times.txt}`` and ``poses/<sequence>.txt``.
    The folder appears when all of it is written, and not at all when that fails. Depth maps are
    16-bit PNG, value / 256 metres, 0 unknown; they are left out where the data set has none.

    Args:
        dataset: what to write; its frames are read once.
        root: the folder that holds ``sequences`` and ``poses``; made where missing.
        sequence: name of the sequence, such as ``00``.
        on_frame: called with each frame's index after it is written.

    Raises:
        DatasetError: the sequence is there already, a frame cannot be read, or no space is left.
    """
    target = root / "sequences" / sequence
    poses = root / "poses" / f"{sequence}.txt"
    if not sequence or Path(sequence).name != sequence:
        raise DatasetError(f"'{sequence}' is no name of a sequence; use one such as 00")
    if poses.exists() or (target.exists() and (target.is_file() or any(target.iterdir()))):
        raise DatasetError(
            f"sequence {sequence} is in {root} already; remove it or choose another name"
        )
    try:
        _write_whole(dataset, target, poses, on_frame)
    except OSError as error:
        raise DatasetError(f"cannot write {target}: {error.strerror or error}") from error


def _write_whole(
    dataset: Dataset, target: Path, poses: Path, on_frame: Callable[[int], None] | None
) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    poses.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        times = _write_frames(dataset, folder, on_frame)
        (folder / "times.txt").write_text("".join(f"{t:.6e}\n" for t in times), encoding="ascii")
        _write_calibration(dataset.info, folder / "calib.txt")
        poses_in_folder = folder / "poses.txt"
        _write_poses(dataset.info, poses_in_folder)
        folder.chmod(0o755)  # mkdtemp keeps others out
        if target.exists():
            target.rmdir()  # it is empty; a rename would refuse
        if poses_in_folder.exists():
            poses_in_folder.rename(poses)
        try:
            folder.rename(target)
        except OSError:
            poses.unlink(missing_ok=True)
            raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write_frames(
    dataset: Dataset, folder: Path, on_frame: Callable[[int], None] | None
) -> list[float]:
    (folder / "image_2").mkdir()
    times = []
    for frame in dataset.frames():
        _write_frame(dataset, frame, folder)
        times.append(frame.time_s)
        if on_frame is not None:
            on_frame(frame.index)
    return times


def _write_frame(dataset: Dataset, frame: Frame, folder: Path) -> None:
    name = f"{frame.index:06d}.png"
    if frame.image is None:
        raise DatasetError(f"frame {frame.index} of {dataset.info.name} cannot be read")
    _write_png(folder / "image_2" / name, np.ascontiguousarray(frame.image[..., ::-1]))
    depth = dataset.true_depth(frame.index)
    if depth is not None:
        (folder / "depth").mkdir(exist_ok=True)
        _write_png(folder / "depth" / name, encode_depth(depth))


def encode_depth(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Turn (H, W) depth in metres to 16-bit steps; 0 where unknown or beyond 255.99 m.

    >>> encode_depth(np.array([[1.5, np.nan, 300.0]], np.float32))
    array([[384,   0,   0]], dtype=uint16)
    """
    steps = np.round(np.nan_to_num(depth.astype(np.float64), nan=0.0) * DEPTH_STEPS_PER_M)
    return np.where(steps < 2**16, steps, 0).astype(np.uint16)


def _write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    is_encoded, data = cv2.imencode(".png", image, fast)
    if not is_encoded:
        raise DatasetError(f"cannot encode {path.name} as PNG")
    path.write_bytes(data.tobytes())  # unlike cv2.imwrite, it says why it cannot


def _write_calibration(info: SequenceInfo, path: Path) -> None:
    """Write P0 to P3: one camera stands for all four, as there is no baseline."""
    if info.intrinsics is None:
        raise DatasetError(f"{info.name} has no intrinsics ({info.intrinsics_source})")
    projection = np.hstack([info.intrinsics, np.zeros((3, 1))])
    row = " ".join(f"{value:.12e}" for value in projection.ravel())
    path.write_text("".join(f"P{k}: {row}\n" for k in range(4)), encoding="ascii")


def _write_poses(info: SequenceInfo, path: Path) -> None:
    if info.truth is None:
        return
    rows = info.truth.world_from_cam[:, :3].reshape(-1, 12)
    text = "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows)
    path.write_text(text, encoding="ascii")
