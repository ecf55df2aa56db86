"""Layer-wise scale alignment: depth in layers, each with a scale of its own.

Reference: LASER (arXiv:2512.13680), section 3.2.
"""

from laser_slam.layers.alignment import LayerCounts, align_layers, first_layers
from laser_slam.layers.correction import apply_layers
from laser_slam.layers.segmenters import SEGMENTERS, Segmenter, make_segmenter
from laser_slam.layers.smoothing import smooth_layers

__all__ = [
    "SEGMENTERS",
    "LayerCounts",
    "Segmenter",
    "align_layers",
    "apply_layers",
    "first_layers",
    "make_segmenter",
    "smooth_layers",
]
