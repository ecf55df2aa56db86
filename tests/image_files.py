"""Little files of images and videos for the tests of the readers."""

from pathlib import Path

import cv2
import numpy as np

from laser_slam.types import Image

HEIGHT, WIDTH = 36, 64


def textured(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Image:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = image[..., ::-1] if image.ndim == 3 else image
    assert cv2.imwrite(str(path), stored)


def write_folder(folder: Path, num: int, suffix: str = ".png") -> Path:
    for index in range(num):
        write_png(folder / f"{index:06d}{suffix}", textured(index))
    return folder


def write_video(path: Path, num: int = 12, size: tuple[int, int] = (48, 64)) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, size[::-1])
    for index in range(num):
        writer.write(np.full((*size, 3), 20 * index % 256, np.uint8))
    writer.release()
    return path


def cut_file(path: Path, share: float = 0.6) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
