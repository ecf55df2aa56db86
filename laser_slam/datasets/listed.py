"""A sequence of which the files of every frame are known: what readers of RGB-D data share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.decoding import (
    Stream,
    check_same_kind,
    give_up_if_unreadable,
    read_ahead,
    read_image,
)
from laser_slam.datasets.lens import Depth, Lens, Undistortion
from laser_slam.errors import DatasetError
from laser_slam.types import Frame, SequenceInfo, Trajectory

Array = NDArray[np.float64]
DepthReader = Callable[[Path, tuple[int, int]], Depth]
"""Reads a file as depth of (height, width): metres, NaN: unknown."""


@dataclass(frozen=True)
class Shot:
    """One frame, before it is read.

    Attributes:
        time_s: seconds.
        image: its file.
        depth: the file of its true depth; None: it has none.
        world_from_cam: (4, 4) true pose, metres; None: unknown.
    """

    time_s: float
    image: Path
    depth: Path | None = None
    world_from_cam: Array | None = None


class ListedSequence:
    """A data set whose images, depth maps and poses are files that were found beforehand.

    Args:
        name: short name of the sequence.
        shots: all frames, in order; times rise.
        lens: intrinsics and lens distortion.
        read_depth: reads a depth map.
        rectify: take the lens distortion out, of images and depth; else it stays in both.

    Raises:
        DatasetError: there is no frame, the images have several sizes, the first one cannot be
            read, or the intrinsics are impossible, or unknown and needed.
    """

    again = "unpack the sequence again"  # what to do about what is broken

    def __init__(
        self,
        name: str,
        shots: Sequence[Shot],
        lens: Lens,
        read_depth: DepthReader,
        *,
        rectify: bool = False,
    ) -> None:
        if not shots:
            raise DatasetError(f"no frames in {name}; {self.again}")
        self._shots = list(shots)
        self._folder = shots[0].image.parent
        self._read_depth = read_depth
        files = tuple(shot.image for shot in self._shots)
        size = check_same_kind(files, self.again).size
        self._undistortion = Undistortion(lens, size) if rectify else None
        intrinsics, source = lens.at(size), lens.source
        if self._undistortion is not None:
            intrinsics = self._undistortion.intrinsics
            files = () if self._undistortion.bends else files  # those are of another camera
        if lens.distortion is not None:
            source += f", lens distortion {'taken out' if rectify else 'left in'}"
        self._info = SequenceInfo(
            name, size, len(self._shots), intrinsics, source, _truth(self._shots), files
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
        jobs = (partial(self._read, index, shot) for index, shot in enumerate(self._shots))
        return give_up_if_unreadable(read_ahead(jobs), self._folder, len(self._shots))

    def true_depth(self, frame: int) -> Depth | None:
        """Return the (H, W) true depth z in metres, NaN: unknown; None: this frame has none.

        Raises:
            DatasetError: the depth map is missing, broken or of another size.
        """
        path = self._shots[frame].depth
        if path is None:
            return None
        if not path.is_file():
            raise DatasetError(f"no depth map {path}; {self.again}")
        depth = self._read_depth(path, self._info.size)
        return depth if self._undistortion is None else self._undistortion.depth(depth)

    def _read(self, index: int, shot: Shot) -> Frame:
        image = read_image(shot.image)
        if image is not None and self._undistortion is not None:
            image = self._undistortion.image(image)
        return Frame(index, shot.time_s, image)


def _truth(shots: Sequence[Shot]) -> Trajectory | None:
    """Collect the poses of the frames that have one; None: no frame has."""
    posed = [
        (index, shot.time_s, shot.world_from_cam)
        for index, shot in enumerate(shots)
        if shot.world_from_cam is not None
    ]
    if not posed:
        return None
    frames, times_s, world_from_cam = zip(*posed, strict=True)
    return Trajectory(np.array(frames, np.int64), np.array(times_s), np.stack(world_from_cam))


def numbered_files(folder: Path, prefix: str, suffixes: Sequence[str]) -> dict[int, Path]:
    """List the files called ``prefix``, a number and one of the suffixes, by their numbers.

    Returns:
        Number to file, rising; empty where there is no such folder.
    """
    if not folder.is_dir():
        return {}
    found = {
        int(path.stem.removeprefix(prefix)): path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes
        and path.stem.startswith(prefix)
        and path.stem.removeprefix(prefix).isdecimal()
    }
    return {number: found[number] for number in sorted(found)}


def require(files: dict[int, Path], what: str, folder: Path, advice: str) -> dict[int, Path]:
    """Refuse a folder without the files that make it a sequence.

    Raises:
        DatasetError: there are none.
    """
    if files:
        return files
    if not folder.is_dir():
        raise DatasetError(f"no folder {folder}; {advice}")
    raise DatasetError(f"no images such as {what} in {folder}; {advice}")
