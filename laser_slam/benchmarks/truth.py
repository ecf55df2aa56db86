"""True points of a map's pixels: as they are, and as published evaluations take them.

The evaluations of pi3 and LASER bend the truth of rooms and shift that of streets, so that a
perfect map has errors. Whoever stands beside their numbers must meet the same truth.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import resize_intrinsics, unproject

Array = NDArray[np.float64]
Depth = NDArray[np.float32]
Index = NDArray[np.int64]
Size = tuple[int, int]
TruePoints = Callable[[Depth, Array, Size], Array]
"""True depth, intrinsics of it and (height, width) of a map -> (H, W, 3) points in camera axes."""

PUBLISHED_WIDTH = 518
PATCH = 14  # pixels; heights are whole ones
MARGIN = 4  # pixels by which the truth of streets is larger before it is cropped
FOCAL_READ_AS = 554.2562584220408 / 525  # 7-Scenes: the evaluation's focal length and the depth's


def exact_points(depth: Depth, intrinsics: Array, size: Size) -> Array:
    """Return the true points of a map's pixels; NaN: unknown."""
    K = resize_intrinsics(intrinsics, _size(depth), size)
    return unproject(resized_depth(depth, size), K)


def room_points(depth: Depth, intrinsics: Array, size: Size, focal_as: float = 1.0) -> Array:
    """Return what the published evaluation of rooms takes for true.

    It scales both axes of the camera with the larger of the two factors, and its focal length of
    7-Scenes is that of NRGBD.

    Args:
        depth: (H, W) true depth.
        intrinsics: (3, 3) of it.
        size: (height, width) of the map.
        focal_as: what the focal length is multiplied with.
    """
    published = published_size(_size(depth))
    factor = max(new / old for new, old in zip(published, depth.shape, strict=True))
    bent = np.array(intrinsics, np.float64)
    bent[[0, 1], [0, 1]] *= factor * focal_as
    bent[:2, 2] = (bent[:2, 2] + 0.5) * factor - 0.5
    return unproject(resized_depth(depth, size), resize_intrinsics(bent, published, size))


def street_points(depth: Depth, intrinsics: Array, size: Size) -> Array:
    """Return what the published evaluation of streets takes for the truth of a map's pixels.

    It crops the truth around the principal point and enlarges it by some pixels of margin more
    than the images, of which the network sees the whole: the points are true, but are those of
    pixels some steps away.
    """
    rows, columns = _street_pixels(_size(depth), intrinsics)
    rows, columns = (
        index[_nearest(num, len(index))] for num, index in zip(size, (rows, columns), strict=True)
    )
    points = unproject(depth, intrinsics)[np.ix_(rows, columns)]
    points[np.ix_(rows < 0, np.ones(len(columns), np.bool_))] = np.nan
    points[np.ix_(np.ones(len(rows), np.bool_), columns < 0)] = np.nan
    return points


seven_scenes_points: TruePoints = partial(room_points, focal_as=FOCAL_READ_AS)


def published_size(size: Size) -> Size:
    """Return (height, width) of published maps of images of a size.

    >>> published_size((480, 640))
    (392, 518)
    """
    return round(size[0] * PUBLISHED_WIDTH / size[1] / PATCH) * PATCH, PUBLISHED_WIDTH


def resized_depth(depth: Depth, size: Size) -> Depth:
    """Take the nearest pixels: means over depth edges would be no truth."""
    rows, columns = (_nearest(new, old) for new, old in zip(size, depth.shape, strict=True))
    return depth[np.ix_(rows, columns)]


def _street_pixels(size: Size, intrinsics: Array) -> tuple[Index, Index]:
    """Return the rows and columns of the truth that published maps are compared with; -1: none."""
    target = published_size(size)
    centre = intrinsics[1, 2], intrinsics[0, 2]
    halves = [int(min(num / 2, c, num - c)) for num, c in zip(size, centre, strict=True)]
    first = [int(c) - half for c, half in zip(centre, halves, strict=True)]
    sides = [2 * half for half in halves]
    factor = max((new + MARGIN) / old for new, old in zip(target, sides, strict=True))
    larger = [int(side * factor) for side in sides]
    actual = max(new / old for new, old in zip(larger, sides, strict=True))
    found = []
    for axis in range(2):
        moved = (centre[axis] - first[axis] + 0.5) * actual - 0.5
        start = int(moved) - int(min(target[axis] / 2, moved))
        index = start + np.arange(target[axis])
        step = 1 / (larger[axis] / sides[axis])  # rounded as OpenCV's nearest pixel is
        there = first[axis] + np.floor(index * step).astype(np.int64)
        found.append(np.where(index < larger[axis], there, -1))
    return found[0], found[1]


def _size(depth: Depth) -> Size:
    return depth.shape[0], depth.shape[1]


def _nearest(num: int, of: int) -> Index:
    return np.clip(((np.arange(num) + 0.5) * of / num).astype(np.int64), 0, of - 1)
