"""What the writers are given: points in portions, depth maps, photos and their cameras."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.config.export import ExportConfig
from laser_slam.errors import RunFolderError
from laser_slam.types import Cloud, Image, Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Points:
    """A map that is read in portions, so that no writer needs all of it at once.

    Attributes:
        portions: reads the map anew, one part at a time; all parts have normals, or none.
        num: points in all.
        low: (3,) smallest coordinates; zeros where there are no points.
        high: (3,) largest coordinates.
        voxel_size: about the distance between points, in the units of the coordinates.
        has_normals: the parts have normals.
        crs: coordinate system, as pyproj understands it; None: of no known one.
    """

    portions: Callable[[], Iterator[Cloud]]
    num: int
    low: Array
    high: Array
    voxel_size: float
    has_normals: bool
    crs: str | None = None


def survey(portions: Callable[[], Iterator[Cloud]], crs: str | None = None) -> Points:
    """Read a map once, to know how large it is.

    Args:
        portions: reads the map anew, one part at a time.
        crs: coordinate system of the points; None: of no known one.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    num, voxel_size, has_normals = 0, 0.0, True
    for cloud in portions():
        voxel_size = max(voxel_size, cloud.voxel_size)
        if not len(cloud.points):
            continue
        num += len(cloud.points)
        low = np.minimum(low, cloud.points.min(axis=0))
        high = np.maximum(high, cloud.points.max(axis=0))
        has_normals &= cloud.normals is not None
    if not num:
        low = high = np.zeros(3)
    return Points(portions, num, low, high, voxel_size, has_normals and num > 0, crs)


def sample(points: Points, most: int) -> Cloud:
    """Take every so many-th point, so that there are at most ``most``."""
    step = max(1, -(-points.num // most))
    parts, start = [], 0
    for cloud in points.portions():
        rows = slice((-start) % step, None, step)
        parts.append((cloud.points[rows], cloud.colors[rows], cloud.weights[rows]))
        start += len(cloud.points)
    if not parts:
        return Cloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.float32))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Cloud(columns[0], columns[1], columns[2], points.voxel_size)


@dataclass(frozen=True)
class DepthView:
    """A keyframe's depth, in world units and at its final place.

    Attributes:
        frame: index in the sequence.
        time_s: seconds.
        depth: (H, W) z along the optical axis; NaN: unknown.
        confidence: (H, W) in [0, 1].
        color: (H, W, 3) RGB.
        intrinsics: (3, 3) in pixels of the depth map, lens distortion taken out.
        world_from_cam: (4, 4) rigid.
    """

    frame: int
    time_s: float
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    color: Image
    intrinsics: Array
    world_from_cam: Array


Views = Callable[[Collection[int] | None], Iterator[DepthView]]


@dataclass(frozen=True)
class Camera:
    """How photos were taken; pixel centres at integers.

    Attributes:
        size: (height, width) in pixels.
        intrinsics: (3, 3) in pixels.
        distortion: (4,) radial k1, k2 and tangential p1, p2 as OpenCV defines them.
    """

    size: tuple[int, int]
    intrinsics: Array
    distortion: Array

    @property
    def is_pinhole(self) -> bool:
        """Tell whether the lens does not bend rays."""
        return not self.distortion.any()

    @property
    def numbers(self) -> list[float]:
        """Return fx, fy, cx, cy with the first pixel's centre at 0.5, as most tools want them."""
        K = self.intrinsics
        return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2] + 0.5), float(K[1, 2] + 0.5)]


@dataclass(frozen=True)
class Photo:
    """An image that goes with the export.

    Attributes:
        name: of the file, without folder.
        frame: index in the sequence.
        camera: that it was taken with, as a row of ``Photos.cameras``.
        world_from_cam: (4, 4) rigid, in world units.
    """

    name: str
    frame: int
    camera: int
    world_from_cam: Array


@dataclass(frozen=True)
class Photos:
    """The images of the keyframes.

    Attributes:
        cameras: that took them.
        photos: in order of their frames.
        save: puts the files into a folder.
    """

    cameras: Sequence[Camera]
    photos: Sequence[Photo]
    save: Callable[[Path], None]


@dataclass(frozen=True)
class Source:
    """All that can be written of a run; what costs time is read when it is asked for.

    Attributes:
        name: of the run's folder, for the messages.
        config: settings of the export.
        trajectory: a pose for every frame.
        points: gives the map.
        views: reads the depth of these keyframes, or of all (None), in order; those without
            depth are left out.
        surfaces: the same without the pixels that the map leaves out, which are NaN.
        photos: gives the images of the keyframes.
        graph: file of the pose graph; None: the run has none.
        made: what one writer has made and another needs too, by its name.
    """

    name: str
    config: ExportConfig
    trajectory: Trajectory
    points: Callable[[], Points]
    views: Views
    surfaces: Views
    photos: Callable[[], Photos]
    graph: Path | None
    made: dict[str, Any] = field(default_factory=dict)

    def some_points(self) -> Points:
        """Return the map.

        Raises:
            RunFolderError: it is empty.
        """
        points = self.points()
        if not points.num:
            raise RunFolderError(
                f"the map of {self.name} is empty: nothing was seen with confidence, "
                "so there is no cloud to export"
            )
        return points
