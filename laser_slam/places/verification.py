"""Whether two images show one place: features that agree on one motion of the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from laser_slam.camera import poselib_camera
from laser_slam.config.places import VerificationConfig
from laser_slam.sim3 import Array
from laser_slam.types import Image

CELLS = (4, 8)  # rows by columns of the grid that tells how far inliers are spread
PER_CELL = 4  # inliers that count: a car of the same make, elsewhere, brings dozens, in few cells
MIN_MATCHES = 8  # of a fundamental matrix; with fewer there is nothing to agree on
CONTRAST = 0.02  # half of OpenCV's threshold: road and walls keep features
RANSAC = {"max_iterations": 2000, "min_iterations": 200, "success_prob": 0.9999, "seed": 0}


@dataclass(frozen=True)
class Features:
    """What verification needs of an image; cheap enough to keep for one that is asked of often.

    Attributes:
        pixels: (N, 2) x, y in pixels of the image as it was given.
        descriptors: (N, 128) of unit length.
        size: (height, width) of the image as it was given.
        factor: pixels of the image per pixel at which features were found.
    """

    pixels: Array
    descriptors: NDArray[np.float32]
    size: tuple[int, int]
    factor: float


@dataclass(frozen=True)
class Verification:
    """What the geometry of two images says of them.

    Attributes:
        num_matches: features that resemble each other and nothing else.
        first_pixels: (M, 2) x, y of the matches that agree on one motion, in the first image.
        second_pixels: (M, 2) the same points in the second image.
        support: number of these, at most ``PER_CELL`` of each cell of a grid over the image, in
            the image where it is less.
        second_from_first: (4, 4) the camera's motion, its translation of unit length and of no
            meaning where the camera only turned; None: intrinsics unknown, or no motion found.
        rejected: why these are not taken for one place, in words; None: they are.
    """

    num_matches: int
    first_pixels: Array
    second_pixels: Array
    support: int
    second_from_first: Array | None
    rejected: str | None

    @property
    def num_inliers(self) -> int:
        """Return the number of matches that agree on one motion."""
        return len(self.first_pixels)

    @property
    def inlier_ratio(self) -> float:
        """Return the share of the matches that agree on one motion; 0 without matches."""
        return self.num_inliers / self.num_matches if self.num_matches else 0.0


def verify(
    first: Features, second: Features, intrinsics: Array | None, config: VerificationConfig
) -> Verification:
    """Judge whether two images show one place.

    Args:
        first: of one image, by ``find_features``.
        second: of the other.
        intrinsics: (3, 3) in pixels of both images as given; None: unknown, and a fundamental
            matrix, which more false matches can agree on, stands in for the essential one.
        config: thresholds.
    """
    i, j = match(first.descriptors, second.descriptors, config.max_ratio)
    a, b = first.pixels[i], second.pixels[j]
    max_error = config.max_error_px * max(first.factor, second.factor)
    motion, inliers = _fit_motion(a, b, intrinsics, max_error)
    a, b = a[inliers], b[inliers]
    support = min(_support(a, first.size), _support(b, second.size))
    result = Verification(len(i), a, b, support, motion, None)
    return replace(result, rejected=_reason_against(result, config))


def find_features(image: Image, config: VerificationConfig) -> Features:
    """Find the features of a (H, W, 3) RGB image: RootSIFT, on an image of reduced width.

    Reference: Arandjelovic and Zisserman, CVPR 2012.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    factor = max(1.0, width / config.width)
    size = (round(width / factor), max(1, round(height / factor)))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if factor > 1 else grey
    sift = cv2.SIFT.create(nfeatures=config.num_features, contrastThreshold=CONTRAST)
    points, descriptors = sift.detectAndCompute(small, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), (height, width), factor)
    steps = np.array([width / size[0], height / size[1]])
    pixels = (np.array([point.pt for point in points]) + 0.5) * steps - 0.5
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(pixels, root.astype(np.float32), (height, width), factor)


def match(
    first: NDArray[np.float32], second: NDArray[np.float32], max_ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of (N, D) and (M, D) unit descriptors that are each other's nearest.

    Args:
        first: of one image.
        second: of the other.
        max_ratio: distance of a match over that of the second best of its first feature.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    cosines = first @ second.T
    best = cosines.argmax(axis=1)
    back = cosines.argmax(axis=0)
    rows = np.arange(len(first))
    two = np.partition(cosines, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2 - 2 * two, 0))  # second best, best
    is_match = (back[best] == rows) & (distance[:, 1] < max_ratio * distance[:, 0])
    return rows[is_match], best[is_match]


def _fit_motion(
    first: Array, second: Array, intrinsics: Array | None, max_error: float
) -> tuple[Array | None, NDArray[np.bool_]]:
    """Return the (4, 4) second_from_first and (N,) which of the matches agree on it."""
    if len(first) < MIN_MATCHES:
        return None, np.zeros(len(first), np.bool_)
    options = {**RANSAC, "max_epipolar_error": max_error}
    if intrinsics is None:
        _, info = poselib.estimate_fundamental(first, second, options)
        return None, np.array(info["inliers"], np.bool_)
    camera = poselib_camera(intrinsics)
    pose, info = poselib.estimate_relative_pose(first, second, camera, camera, options)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = pose.R, pose.t
    return motion, np.array(info["inliers"], np.bool_)


def _support(pixels: Array, size: tuple[int, int]) -> int:
    """Count (N, 2) pixels, at most ``PER_CELL`` of each cell."""
    cells = np.floor(pixels[:, ::-1] / size * CELLS).astype(np.int64)
    cells = np.clip(cells, 0, np.array(CELLS) - 1)
    counts = np.bincount(cells[:, 0] * CELLS[1] + cells[:, 1])
    return int(np.minimum(counts, PER_CELL).sum())


def _reason_against(result: Verification, config: VerificationConfig) -> str | None:
    """Say in words which threshold two images fail; None: none."""
    if result.support < config.min_support:
        return (
            f"{result.num_inliers} inliers count for {result.support} by their spread, "
            f"need {config.min_support}"
        )
    if result.inlier_ratio < config.min_inlier_ratio:
        return f"inlier ratio {result.inlier_ratio:.2f}, need {config.min_inlier_ratio:.2f}"
    return None
