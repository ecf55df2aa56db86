"""Tileable noise with mip levels, and analytic filters: what keeps the pictures free of jaggies."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from laser_slam.datasets.synthetic.kernels import inlined, kernel

GRAIN, CLOUDS, LEAVES = 0, 1, 2
SIZE = 512
LEVELS = 10  # 512, 256, ..., 1


class Textures(NamedTuple):
    """Three noise images, zero mean and unit deviation, each with all its mip levels.

    Attributes:
        values: (3, texels) levels one after another, row by row.
        offsets: (LEVELS,) where each level begins.
    """

    values: NDArray[np.float32]
    offsets: NDArray[np.int64]


def make_textures(seed: int) -> Textures:
    """Draw the noise images: grain and clouds by their spectrum, leaves by the sign of noise."""
    rng = np.random.default_rng((seed, 2))
    leaves = np.tanh(2.0 * _spectral(0.55, rng)) + 0.45 * _spectral(1.2, rng)
    images = [_spectral(0.5, rng), _spectral(1.25, rng), leaves]
    rows = [_mip_chain((image - image.mean()) / image.std()) for image in images]
    sizes = [(SIZE >> level) ** 2 for level in range(LEVELS)]
    return Textures(np.array(rows, np.float32), np.cumsum([0, *sizes[:-1]]).astype(np.int64))


def _spectral(power: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return tileable (SIZE, SIZE) noise whose amplitude falls as frequency ** -power."""
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None]) * SIZE
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / np.maximum(frequency, 1) ** power
    spectrum[frequency < 1.5] = 0  # no wave as long as the tile: the repetition would show
    noise = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.asarray(noise / noise.std())


def _mip_chain(image: NDArray[np.float64]) -> NDArray[np.float64]:
    levels = [image]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(half, 2, half, 2).mean(axis=(1, 3)))
    return np.concatenate([level.ravel() for level in levels])


@kernel
def _bilinear(textures: Textures, kind: int, x: float, y: float, level: int) -> Any:
    size = SIZE >> level
    fx, fy = x * size - 0.5, y * size - 0.5
    x0, y0 = int(np.floor(fx)), int(np.floor(fy))
    wx, wy = fx - x0, fy - y0
    mask, base = size - 1, textures.offsets[level]
    left, right = x0 & mask, (x0 + 1) & mask
    top, bottom = base + (y0 & mask) * size, base + ((y0 + 1) & mask) * size
    values = textures.values
    upper = values[kind, top + left] * (1 - wx) + values[kind, top + right] * wx
    lower = values[kind, bottom + left] * (1 - wx) + values[kind, bottom + right] * wx
    return upper * (1 - wy) + lower * wy


@kernel
def noise(textures: Textures, kind: int, x: float, y: float, footprint: float) -> Any:
    """Sample a noise image, filtered to the pixel's footprint; both in tiles (one period = 1)."""
    lod = np.log2(max(footprint * SIZE, 1.0))
    level = int(lod)
    if level >= LEVELS - 2:
        return 0.0
    weight = lod - level
    fine = _bilinear(textures, kind, x, y, level)
    return fine * (1 - weight) + _bilinear(textures, kind, x, y, level + 1) * weight


@inlined
def hash01(a: int, b: int, c: int) -> Any:
    """Return a number in [0, 1) that looks random and depends on three integers only."""
    h = (a * 374761393 + b * 668265263 + c * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return (h ^ (h >> 15)) / 4294967296.0


@inlined
def band(x: float, low: float, high: float, width: float) -> Any:
    """Return the share of the interval of ``width`` around ``x`` that lies in [low, high]."""
    width = max(width, 1e-6)
    inside = min(x + 0.5 * width, high) - max(x - 0.5 * width, low)
    return min(max(inside / width, 0.0), 1.0)


@inlined
def _pulse_integral(x: float, period: float, on: float) -> Any:
    cycles = np.floor(x / period)
    return cycles * on + min(x - cycles * period, on)


@inlined
def pulse(x: float, period: float, on: float, width: float) -> Any:
    """Return the share of the interval of ``width`` around ``x`` where a pulse train is on.

    The train is on in [0, ``on``) of each ``period``.
    """
    width = max(width, 1e-6)
    high = _pulse_integral(x + 0.5 * width, period, on)
    return (high - _pulse_integral(x - 0.5 * width, period, on)) / width
