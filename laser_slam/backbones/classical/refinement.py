"""Measure tracks again at full resolution, with patches warped by the geometry that is known.

Tracking moves a patch without deforming it. On a road or a facade that comes nearer, the flow
inside the patch is not uniform, and its mean is longer than the flow of the centre: every window
is then a little too large. Once depth and poses are roughly known, each patch can be warped
through its plane, and compared with one reference view instead of the frame before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.classical.bundle import Bundle
from laser_slam.backbones.classical.refinement_kernels import refine_points

# Facing the camera, lying on the ground, standing beside the road: normals in camera axes.
NORMALS = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def refine(bundle: Bundle, images: NDArray[np.float32], radius: int) -> NDArray[np.bool_]:
    """Align every observation with the patch of the point's middle view, in place.

    Args:
        bundle: adjusted points and poses; its pixels are replaced.
        images: (C, H, W) slightly blurred grey images.
        radius: half side of the patch in pixels.

    Returns:
        (M,) observations whose patch was found again.
    """
    found = np.zeros(len(bundle.cameras), bool)
    refine_points(
        images,
        bundle.rotations,
        bundle.translations,
        bundle.points,
        bundle.cameras,
        bundle.starts,
        bundle.pixels,
        bundle.intrinsics,
        radius,
        NORMALS,
        found,
    )
    return found
