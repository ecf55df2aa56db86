"""KITTI's published calibrations of its five days of recording, for drives without the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Day:
    """The numbers of a day that left colour and left grey images and scans need.

    Attributes:
        size: (width, height) of rectified images, in pixels.
        camera: f, cx, cy of all rectified cameras, in pixels.
        color: fourth column of ``P_rect_02``: pixels times metres twice, then metres.
        rectified_from_cam0: ``R_rect_00``, row by row.
        rotation_cam0_from_velo: ``R`` of ``calib_velo_to_cam.txt``, row by row; not rectified.
        translation_cam0_from_velo: ``T`` of the same file, metres.
    """

    size: tuple[int, int]
    camera: tuple[float, float, float]
    color: tuple[float, float, float]
    rectified_from_cam0: tuple[float, ...]
    rotation_cam0_from_velo: tuple[float, ...]
    translation_cam0_from_velo: tuple[float, float, float]

    def cameras(self) -> dict[str, Array]:
        """Return the rows of ``calib_cam_to_cam.txt``."""
        f, cx, cy = self.camera
        K = intrinsics_matrix(f, f, cx, cy)
        rows = {"R_rect_00": np.array(self.rectified_from_cam0)}
        for number, column in (("00", (0.0, 0.0, 0.0)), ("02", self.color)):
            rows[f"S_rect_{number}"] = np.array(self.size, np.float64)
            rows[f"P_rect_{number}"] = np.column_stack([K, column]).ravel()
        return rows

    def scanner(self) -> dict[str, Array]:
        """Return the rows of ``calib_velo_to_cam.txt``."""
        return {
            "R": np.array(self.rotation_cam0_from_velo),
            "T": np.array(self.translation_cam0_from_velo),
        }


# fmt: off
DAYS: Mapping[str, Day] = MappingProxyType({
    "2011_09_26": Day(
        (1242, 375), (721.5377, 609.5593, 172.8540), (44.85728, 0.2163791, 2.745884e-3),
        (9.999239e-01, 9.837760e-03, -7.445048e-03, -9.869795e-03, 9.999421e-01, -4.278459e-03,
         7.402527e-03, 4.351614e-03, 9.999631e-01),
        (7.533745e-03, -9.999714e-01, -6.166020e-04, 1.480249e-02, 7.280733e-04, -9.998902e-01,
         9.998621e-01, 7.523790e-03, 1.480755e-02),
        (-4.069766e-03, -7.631618e-02, -2.717806e-01),
    ),
    "2011_09_28": Day(
        (1224, 370), (707.0493, 604.0814, 180.5066), (45.75831, -0.3454157, 4.981016e-3),
        (9.999128e-01, 1.009263e-02, -8.511932e-03, -1.012729e-02, 9.999406e-01, -4.037671e-03,
         8.470675e-03, 4.123522e-03, 9.999556e-01),
        (6.927964e-03, -9.999722e-01, -2.757829e-03, -1.162982e-03, 2.749836e-03, -9.999955e-01,
         9.999753e-01, 6.931141e-03, -1.143899e-03),
        (-2.457729e-02, -6.127237e-02, -3.321029e-01),
    ),
    "2011_09_29": Day(
        (1238, 374), (718.3351, 600.3891, 181.5122), (44.50382, -0.5951107, 2.616315e-3),
        (9.999478e-01, 9.791707e-03, -2.925305e-03, -9.806939e-03, 9.999382e-01, -5.238719e-03,
         2.873828e-03, 5.267134e-03, 9.999820e-01),
        (7.755449e-03, -9.999694e-01, -1.014303e-03, 2.294056e-03, 1.032122e-03, -9.999968e-01,
         9.999673e-01, 7.753097e-03, 2.301990e-03),
        (-7.275538e-03, -6.324057e-02, -2.670414e-01),
    ),
    "2011_09_30": Day(
        (1226, 370), (707.0912, 601.8873, 183.1104), (46.88783, 0.1178601, 6.203223e-3),
        (9.999280e-01, 8.085985e-03, -8.866797e-03, -8.123205e-03, 9.999583e-01, -4.169750e-03,
         8.832711e-03, 4.241477e-03, 9.999520e-01),
        (7.027555e-03, -9.999753e-01, 2.599616e-05, -2.254837e-03, -4.184312e-05, -9.999975e-01,
         9.999728e-01, 7.027479e-03, -2.255075e-03),
        (-7.137748e-03, -7.482656e-02, -3.336324e-01),
    ),
    "2011_10_03": Day(
        (1241, 376), (718.8560, 607.1928, 185.2157), (45.38225, -0.1130887, 3.779761e-3),
        (9.999454e-01, 7.259129e-03, -7.519551e-03, -7.292213e-03, 9.999638e-01, -4.381729e-03,
         7.487471e-03, 4.436324e-03, 9.999621e-01),
        (7.967514e-03, -9.999679e-01, -8.462264e-04, -2.771053e-03, 8.241710e-04, -9.999958e-01,
         9.999644e-01, 7.969825e-03, -2.764397e-03),
        (-1.377769e-02, -5.542117e-02, -2.918589e-01),
    ),
})
# fmt: on
