"""From true depth to distorted depth and its confidence, pixel by pixel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.backbones.simulated.hash_kernels import mix, normal, uniform

Map = NDArray[np.float32]
Keys = NDArray[np.uint64]

CURVE_REACH = 4.0  # the curve spans exp(-4) to exp(4) median depths
SQRT_12 = np.sqrt(12.0)
NOISE_RANGE = (0.5, 2.0)  # median depths between which noise grows, as the root of depth
# What makes a pixel doubtful: the bend of inverse depth, depth, the variance of its noise.
EDGE_WEIGHT, MAX_EDGE, FAR_WEIGHT, NOISE_WEIGHT = 10.0, 3.0, 0.1, 0.3
EDGE_OF_KNOWN = 0.1  # the bend that a border to unknown depth counts as
VAGUE_PENALTY = 0.4  # of a confidence that says nothing, in the middle


class LayerLaw(NamedTuple):
    """How the factor of a layer is drawn: a part for the run and a part for the window."""

    common_seed: np.uint64
    own_seed: np.uint64
    common_sigma: float
    own_sigma: float
    is_uniform: bool


class NoiseLaw(NamedTuple):
    """Noise of one frame, in log depth, and how well confidence knows of it."""

    smooth_sigma: float
    common_seed: np.uint64
    own_seed: np.uint64
    common_sigma: float
    own_sigma: float
    confidence_told: float
    blob_told: float
    unit: float


@njit(cache=True, nogil=True)
def weave(down: Map, grids: Map, across: Map, out: Map) -> None:
    """Make smooth maps of knots; BLAS would do it on threads of its own, under those of frames.

    Args:
        down: (H, R) weights of the rows of knots.
        grids: (K, R, C) knots.
        across: (C, W) weights of the columns of knots.
        out: (K, H, W) is filled.
    """
    row = np.empty(grids.shape[2], np.float32)
    for k in range(len(grids)):
        for y in range(len(down)):
            row[:] = 0
            for r in range(grids.shape[1]):
                for c in range(grids.shape[2]):
                    row[c] += down[y, r] * grids[k, r, c]
            for x in range(across.shape[1]):
                out[k, y, x] = 0
            for c in range(grids.shape[2]):
                weight = row[c]
                for x in range(across.shape[1]):
                    out[k, y, x] += weight * across[c, x]


@njit(cache=True, nogil=True)
def layer_log_factor(key: np.uint64, law: LayerLaw) -> float:
    """Return the logarithm of a layer's factor."""
    common, own = mix(key, law.common_seed), mix(key, law.own_seed)
    if law.is_uniform:
        a, b = (uniform(common, 0) - 0.5) * SQRT_12, (uniform(own, 0) - 0.5) * SQRT_12
    else:
        a, b = normal(common), normal(own)
    return float(law.common_sigma * a + law.own_sigma * b)


@njit(cache=True, nogil=True)
def band_keys(depth: Map, width: float) -> Keys:
    """Return the band of log depth that each pixel lies in; 0 where depth is unknown."""
    keys = np.zeros(depth.shape, np.uint64)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            if depth[y, x] > 0:
                keys[y, x] = np.uint64(int(np.floor(np.log(depth[y, x]) / width)) + (1 << 20))
    return keys


@njit(cache=True, nogil=True)
def distort(depth: Map, keys: Keys, curve: Map, law: LayerLaw) -> Map:
    """Multiply depth by the curve over its logarithm and by the factor of its layer.

    Args:
        depth: (H, W) true, in median depths of the window; NaN: unknown.
        keys: (H, W) layer of each pixel.
        curve: (K,) log factor from exp(-CURVE_REACH) to exp(CURVE_REACH) median depths.
        law: how the factors of the layers are drawn.

    Returns:
        (H, W) inverse depth; 0: unknown.
    """
    out = np.zeros(depth.shape, np.float32)
    last_key, factor = np.uint64(0), layer_log_factor(np.uint64(0), law)
    per_log = (len(curve) - 1) / (2 * CURVE_REACH)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            if not depth[y, x] > 0:
                continue
            if keys[y, x] != last_key:
                last_key = keys[y, x]
                factor = layer_log_factor(last_key, law)
            place = (np.log(depth[y, x]) + np.float32(CURVE_REACH)) * np.float32(per_log)
            place = min(max(place, np.float32(0)), np.float32(len(curve) - 1.001))
            left = int(place)
            bend = curve[left] + (place - left) * (curve[left + 1] - curve[left])
            out[y, x] = np.exp(-np.float32(bend + factor)) / depth[y, x]
    return out


@njit(cache=True, nogil=True, _nrt=False)
def add_noise(
    inverse: Map,
    fields: Map,
    blobs: NDArray[np.uint8],
    blob_factors: Map,
    law: NoiseLaw,
    depth: Map,
    confidence: Map,
) -> None:
    """Add noise and outliers, and say how sure a network would be.

    Args:
        inverse: (H, W) inverse depth in median depths; 0: unknown.
        fields: (3, H, W) smooth, of variance 1: the noise, the logarithm of its local strength,
            and what makes confidence wrong.
        blobs: (H, W) outlier blob of each pixel; 0: none.
        blob_factors: (B,) on the depth of each blob, 1 for blob 0.
        law: strengths, seeds, and the window units in a median depth.
        depth: (H, W), is filled: z in window units, NaN: unknown.
        confidence: (H, W), is filled.
    """
    height, width = inverse.shape
    for y in range(height):
        for x in range(width):
            here = inverse[y, x]
            if here == 0:
                depth[y, x], confidence[y, x] = np.nan, 0
                continue
            reach = min(max(1 / here, np.float32(NOISE_RANGE[0])), np.float32(NOISE_RANGE[1]))
            strength = np.exp(np.float32(0.5) * (fields[1, y, x] - np.float32(0.5)))
            variance = strength * strength * reach
            error = law.smooth_sigma * fields[0, y, x] * np.sqrt(variance)
            pixel = np.uint64(y * width + x)
            if law.common_sigma > 0:
                noise = normal(mix(pixel, law.common_seed))
                error += law.common_sigma * np.sqrt(variance) * noise
            if law.own_sigma > 0:
                error += law.own_sigma * np.sqrt(variance) * normal(mix(pixel, law.own_seed))
            blob = blobs[y, x]
            z = blob_factors[blob] * law.unit * np.exp(np.float32(error)) / here
            doubt = NOISE_WEIGHT * variance + FAR_WEIGHT / here
            doubt += min(EDGE_WEIGHT * _bend(inverse, y, x), MAX_EDGE)
            vague = VAGUE_PENALTY * np.exp(fields[2, y, x])
            sure = 1 / (1 + law.confidence_told * doubt + (1 - law.confidence_told) * vague)
            if blob > 0:
                sure *= 1 - law.blob_told
            depth[y, x], confidence[y, x] = z, sure


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _bend(inverse: Map, y: int, x: int) -> float:
    """Return how much inverse depth bends, relative to itself: a plane does not, an edge does."""
    height, width = inverse.shape
    here, bend = inverse[y, x], np.float32(0)
    if 0 < x < width - 1:
        left, right = inverse[y, x - 1], inverse[y, x + 1]
        if left == 0 or right == 0:
            return EDGE_OF_KNOWN
        bend = abs(left + right - 2 * here)
    if 0 < y < height - 1:
        above, below = inverse[y - 1, x], inverse[y + 1, x]
        if above == 0 or below == 0:
            return EDGE_OF_KNOWN
        bend = max(bend, abs(above + below - 2 * here))
    return float(bend / here)
