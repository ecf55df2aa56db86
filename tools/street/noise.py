"""What networks do wrong with depth: smeared edges, smooth noise, blobs of nonsense."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LARGEST_OUTLIER = np.log(2.8)  # outliers are wrong by up to this factor, either way
_EDGE_JUMP = 0.05  # depth step that makes an edge, in its depth
_NOISE_CELLS = 3  # of smooth noise from top to bottom
_NOISE_MEMORY = 0.85  # correlation of smooth noise between neighbouring frames


def smear(depth: Array, sigma: float) -> tuple[Array, NDArray[np.bool_]]:
    """Smear (H, W) depth at its edges, where networks and resizing mix near and far.

    Returns:
        The depth, and True as far from an edge as the smear reaches.
    """
    is_edge = _edges(depth, sigma)
    return np.where(is_edge, cv2.GaussianBlur(depth, (0, 0), sigma), depth), is_edge


def _edges(depth: Array, sigma: float) -> NDArray[np.bool_]:
    size = 2 * round(2.5 * sigma) + 1
    window = np.ones((size, size), np.uint8)
    steps = cv2.dilate(depth, np.ones((3, 3))) / cv2.erode(depth, np.ones((3, 3)))
    # The ground rises steeply in depth near the horizon, but evenly: that is no edge.
    bend = np.abs(cv2.Laplacian(depth, cv2.CV_64F)) / depth
    is_edge = (steps > 1 + _EDGE_JUMP) & (bend > _EDGE_JUMP)
    return np.asarray(cv2.dilate(is_edge.astype(np.uint8), window)).astype(bool)


def smooth_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return unit-variance noise that changes slowly over the image and over time."""
    num, height, width = shape
    cells = (_NOISE_CELLS + 2, _NOISE_CELLS * width // height + 2)
    out, grid = np.empty(shape), rng.normal(size=cells)
    for frame in range(num):
        fresh = rng.normal(size=cells)
        grid = _NOISE_MEMORY * grid + np.sqrt(1 - _NOISE_MEMORY**2) * fresh
        out[frame] = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(out / out.std())


def outliers(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> Array:
    """Return (N, H, W) log-factors of ellipses that drift over a few frames; 0 elsewhere."""
    num, height, width = shape
    out, phase, num_blobs = np.zeros(shape), rng.uniform(), 0
    while np.count_nonzero(out) < share * out.size:
        fewest, life = np.argmin(np.count_nonzero(out, axis=(1, 2))), int(rng.integers(3, 9))
        start = int(fewest) - int(rng.integers(life))
        center, drift = rng.uniform((0, 0), (width, height)), rng.normal(scale=3.0, size=2)
        axes = rng.uniform(0.08, 0.25, 2) * height
        # Golden steps cover the range evenly, so that few blobs are as wrong as many.
        wrong = _LARGEST_OUTLIER * (2 * ((phase + 0.618 * num_blobs) % 1) - 1)
        for frame in range(max(start, 0), min(start + life, num)):
            at = np.rint(center + (frame - start) * drift).astype(int)
            ellipse = (tuple(at.tolist()), tuple(np.rint(axes).astype(int).tolist()))
            cv2.ellipse(out[frame], *ellipse, 0.0, 0.0, 360.0, wrong, -1)
        num_blobs += 1
    return out


def confidence(
    truth: Array, is_edge: NDArray[np.bool_], is_sky: NDArray[np.bool_], rng: np.random.Generator
) -> Array:
    """Return high confidence near by, low at edges, far away and in the sky.

    Args:
        truth: (N, H, W) in metres.
        is_edge: (N, H, W) where depth is smeared.
        is_sky: (N, H, W) where there is none.
        rng: of its own noise.
    """
    out = 0.9 / (1 + (truth / 70.0) ** 4) * np.where(is_edge, 0.4, 1.0)
    out += 0.05 * rng.normal(size=truth.shape)
    out[is_sky] = 0.02
    return np.asarray(np.clip(out, 0.01, 1.0))
