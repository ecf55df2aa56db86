"""Smooth random curves and maps of variance 1, and blobs; cheap enough for every frame."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from laser_slam.backbones.simulated.depth_kernels import weave

Map = NDArray[np.float32]

BLOB_RADIUS = (0.02, 0.07)  # of the image's width
LARGEST_FACTOR = 1 / 0.3
MAX_BLOBS = 255


@cache
def spline_basis(num_knots: int, num: int) -> Map:
    """Return the (num, num_knots) matrix from independent knots to a smooth curve.

    Its rows have length 1: knots of variance 1 make a curve of variance 1 everywhere.
    """
    if num_knots == 1:
        return np.ones((num, 1), np.float32)
    spline = CubicSpline(np.arange(num_knots), np.eye(num_knots), bc_type="natural")
    basis = spline(np.linspace(0, num_knots - 1, num))
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    return np.asarray(basis, np.float32)


def num_knots(length: int, spacing: float) -> int:
    """Return how many knots about ``spacing`` apart span ``length``."""
    return max(1, round(length / spacing) + 1)


def smooth_maps(grids: Map, size: tuple[int, int]) -> Map:
    """Make (K, H, W) smooth maps of (K, rows, columns) knots."""
    down = spline_basis(grids.shape[1], size[0])
    across = np.ascontiguousarray(spline_basis(grids.shape[2], size[1]).T)
    out = np.empty((len(grids), *size), np.float32)
    weave(down, grids, across, out)
    return out


def add_blobs(
    labels: NDArray[np.uint8], factors: list[float], share: float, generator: np.random.Generator
) -> None:
    """Paint ellipses until they cover ``share`` more of the image, each with a factor of its own.

    Args:
        labels: (H, W) is painted; 0: no blob.
        factors: on the depth of each blob, log-uniform in 0.3 to 3.3, are appended.
        share: of the pixels.
        generator: of the blobs.
    """
    height, width = labels.shape
    goal = min(cv2.countNonZero(labels) + share * labels.size, labels.size)
    missing = goal - cv2.countNonZero(labels)
    while missing >= 1 and len(factors) <= MAX_BLOBS:
        x, y, tilt, size, aspect, factor = generator.random(6)
        radius = width * (BLOB_RADIUS[0] + size * (BLOB_RADIUS[1] - BLOB_RADIUS[0]))
        radius = min(radius, np.sqrt(missing / np.pi) + 0.5)  # the last one fills up
        stretch = np.exp(0.6 * (aspect - 0.5))
        cv2.ellipse(
            labels,
            (round(x * width), round(y * height)),
            (round(radius * stretch), round(radius / stretch)),
            180 * tilt,
            0,
            360,
            len(factors),
            -1,
        )
        factors.append(float(LARGEST_FACTOR ** (2 * factor - 1)))
        missing = goal - cv2.countNonZero(labels)
