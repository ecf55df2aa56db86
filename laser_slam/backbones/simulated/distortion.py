"""The depth errors of one window: smooth, by layer, noise, blurred edges, outliers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.simulated.depth_kernels import (
    LayerLaw,
    NoiseLaw,
    add_noise,
    band_keys,
    distort,
)
from laser_slam.backbones.simulated.draws import Draws, Purpose
from laser_slam.backbones.simulated.fields import (
    add_blobs,
    num_knots,
    smooth_maps,
    spline_basis,
)
from laser_slam.config import SimulatedConfig

Map = NDArray[np.float32]
Keys = NDArray[np.uint64]

CURVE_KNOTS = 8  # 1.1 apart in log depth
CURVE_SAMPLES = 257


class Distortion:
    """What is wrong with the depth of one window; the same whenever it is asked for."""

    def __init__(self, config: SimulatedConfig, draws: Draws) -> None:
        self._config = config
        self._draws = draws
        knots = draws.normals(Purpose.CURVE, (CURVE_KNOTS,))
        basis = spline_basis(CURVE_KNOTS, CURVE_SAMPLES)
        self._curve = np.asarray(config.smooth_sigma * (basis @ knots), np.float32)
        self._layers = LayerLaw(
            _bits(draws.common(Purpose.LAYERS)),
            _bits(draws.own(Purpose.LAYERS)),
            config.layer_sigma * draws.common_weight,
            config.layer_sigma * draws.own_weight,
            config.layer_law == "uniform",
        )

    def bands(self, depth: Map) -> Keys:
        """Return (H, W) the band of log depth of each pixel; ``depth`` in median depths."""
        return np.asarray(band_keys(depth, self._config.band_width))

    def structure(self, depth: Map, keys: Keys | None) -> Map:
        """Distort smoothly and by layers, and blur the edges.

        Args:
            depth: (H, W) true, in median depths; NaN: unknown.
            keys: (H, W) layers; None: layers are as they should be.

        Returns:
            (H, W) inverse depth in inverse median depths; 0: unknown.
        """
        law = self._layers
        if keys is None:
            keys, law = np.zeros(depth.shape, np.uint64), law._replace(common_sigma=0, own_sigma=0)
        inverse = np.asarray(distort(depth, keys, self._curve, law), np.float32)
        return _blur(inverse, self._config.edge_blur_px) if self._config.edge_blur_px else inverse

    def noise(self, inverse: Map, frame: int, unit: float, out: tuple[Map, Map]) -> None:
        """Add what differs from frame to frame.

        Args:
            inverse: (H, W) what ``structure`` gave.
            frame: its index in the sequence.
            unit: window units in a median depth.
            out: (H, W) depth in window units and (H, W) confidence, which are filled.
        """
        config, draws, size = self._config, self._draws, (inverse.shape[0], inverse.shape[1])
        knots = num_knots(size[0], config.noise_px), num_knots(size[1], config.noise_px)
        fields = smooth_maps(draws.normals(Purpose.FIELDS, (3, *knots), frame), size)
        labels, factors = np.zeros(size, np.uint8), [1.0]
        if config.blob_share > 0:
            common, own = draws.common(Purpose.BLOBS, frame), draws.own(Purpose.BLOBS, frame)
            add_blobs(labels, factors, config.blob_share * draws.persistence, common)
            add_blobs(labels, factors, config.blob_share * (1 - draws.persistence), own)
        law = NoiseLaw(
            config.noise_smooth,
            _bits(draws.common(Purpose.FIELDS, frame)),
            _bits(draws.own(Purpose.FIELDS, frame)),
            config.noise_iid * draws.common_weight,
            config.noise_iid * draws.own_weight,
            config.confidence_told,
            config.blob_told,
            unit,
        )
        add_noise(inverse, fields, labels, np.array(factors, np.float32), law, *out)


def _bits(generator: np.random.Generator) -> np.uint64:
    return np.uint64(generator.integers(0, 2**64, dtype=np.uint64))


def _blur(inverse: Map, sigma_px: float) -> Map:
    """Blur what is known of inverse depth: a plane stays, an edge becomes a slope."""
    blurred = cv2.GaussianBlur(inverse, (0, 0), sigma_px)
    known = inverse > 0
    if not known.all():
        share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma_px)
        blurred = np.where(known, blurred / np.maximum(share, 1e-3), np.float32(0))
    return np.asarray(blurred, np.float32)
