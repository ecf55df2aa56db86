"""A folder of images: own material without calibration or times."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import DatasetConfig
from laser_slam.datasets.decoding import (
    SUFFIXES,
    Stream,
    check_same_kind,
    give_up_if_unreadable,
    orientation_of,
    read_ahead,
    read_exif,
    read_image,
)
from laser_slam.datasets.intrinsics import choose_intrinsics
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo

DEFAULTS = DatasetConfig()
MIN_IMAGES = 3
ADVICE = "keep one kind in the folder, or pick them by a pattern such as 'DIR/*.color.jpg'"


class ImageFolder:
    """The images of one folder in natural order (frame2 before frame10).

    All images are taken as the first one's EXIF orientation says, so that a camera that was
    tipped in between stays one camera.

    Args:
        folder: with the images; its last part may be a pattern such as ``*.color.jpg``.
        intrinsics: (3, 3) in pixels of the upright images; None: not given.
        fov_deg: horizontal field of view; None: not given.
        fps: frames per second, which gives the times.

    Raises:
        DatasetError: no such folder, fewer than 3 images, images of several sizes, an unreadable
            first image, or impossible intrinsics.
    """

    def __init__(
        self,
        folder: Path,
        intrinsics: NDArray[np.float64] | None = None,
        fov_deg: float | None = None,
        fps: float = DEFAULTS.fps,
    ) -> None:
        self._folder, self._fps = folder, fps
        self._paths = list_images(folder)
        if len(self._paths) < MIN_IMAGES:
            raise DatasetError(_too_few(folder, self._paths))
        header = check_same_kind(self._paths, ADVICE)
        exif = read_exif(self._paths[0])
        self._orientation = orientation_of(exif)
        size = header.size if self._orientation < 5 else header.size[::-1]
        matrix, source = choose_intrinsics(size, intrinsics, fov_deg, exif)
        named = folder.resolve()
        self._info = SequenceInfo(
            named.parent.name if _is_pattern(folder) else named.name,
            size,
            len(self._paths),
            matrix,
            source,
            files=tuple(self._paths),
        )

    @property
    def info(self) -> SequenceInfo:
        """Say what is known before the images are read."""
        return self._info

    def frames(self) -> Stream[Frame]:
        """Read the images in order, a few ahead; an unreadable one comes as None.

        Raises:
            DatasetError: the first image or more than half of all are unreadable.
        """
        jobs = (partial(self._read, index) for index in range(len(self._paths)))
        return give_up_if_unreadable(read_ahead(jobs), self._folder, len(self._paths))

    def true_depth(self, frame: int) -> None:
        """Return None: a folder of images has no truth."""

    def _read(self, index: int) -> Frame:
        image = read_image(self._paths[index], self._orientation)
        return Frame(index, index / self._fps, image)


def list_images(folder: Path) -> list[Path]:
    """List the image files of a folder, or of a pattern in it, in natural order.

    Raises:
        DatasetError: the folder is missing or is a file.
    """
    directory, pattern = (folder.parent, folder.name) if _is_pattern(folder) else (folder, "*")
    if directory.is_file():
        raise DatasetError(
            f"{directory} is a file, not a folder of images; for a video use 'laser-slam video'"
        )
    if not directory.is_dir():
        raise DatasetError(f"no folder {directory}; give a folder that holds the images")
    images = (
        path
        for path in directory.glob(pattern)
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    )
    return sorted(images, key=natural_key)


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort names by the numbers in them.

    >>> sorted([Path("f10.png"), Path("f9.png")], key=natural_key)[0].name
    'f9.png'
    """
    parts = re.findall(r"\d+|\D+", path.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in parts]


def _is_pattern(folder: Path) -> bool:
    return any(sign in folder.name for sign in "*?[") and not folder.exists()


def _too_few(folder: Path, paths: list[Path]) -> str:
    found = f"{len(paths)} image{'s' if len(paths) > 1 else ''}" if paths else "no images"
    return (
        f"{found} in {folder}, need at least {MIN_IMAGES} "
        f"({' '.join(SUFFIXES)}); give the folder that holds the images themselves"
    )
