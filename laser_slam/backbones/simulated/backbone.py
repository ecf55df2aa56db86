"""The truth of a data set, distorted: for experiments whose errors are known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.simulated.distortion import Distortion
from laser_slam.backbones.simulated.draws import Draws, Purpose
from laser_slam.backbones.simulated.gravity import guess_down, level_axes, settle_down
from laser_slam.backbones.simulated.pieces import Pieces
from laser_slam.backbones.simulated.poses import distort_poses
from laser_slam.backbones.simulated.truth import STRIDE, TrueDepth, Truth, WindowTruth
from laser_slam.config import BackboneConfig
from laser_slam.dependencies import num_threads
from laser_slam.types import (
    NO_DISTORTION,
    Calibration,
    Image,
    Prediction,
    SequenceInfo,
    Window,
    WindowStatus,
)

Array = NDArray[np.float64]
Map = NDArray[np.float32]

FAR_FRAMES = 50  # between neighbours of one window: it was put together from two places
PATCH_PX = 14  # networks want whole patches
SIMULATED = (
    "simulated: depth and poses are the data set's own truth with errors added, "
    "not a reconstruction from its images"
)


class SimulatedBackbone:
    """No reconstruction at all: ground-truth depth and poses, with the errors of networks added.

    The errors of a window depend on the settings and on its frames only, not on what was asked
    before. Its unit is its median depth times a random factor; depth and translations agree about
    it in the median. Depth that the data set does not know stays unknown. A frame without true
    pose gets one from its neighbours. The images are not looked at: any will do.

    Args:
        config: which errors, and how large.
        info: of the data set; its truth is world_from_cam in metres.
        true_depth: gives (H, W) metres, NaN: unknown, of a frame, or None; None: has no depth.

    Attributes:
        remembers: False, see `laser_slam.backbones.base.Backbone`.
        sees_far_frames: True, same.

    Raises:
        ConfigError: the data set lacks true poses or depth, or the intrinsics.
    """

    remembers = False
    sees_far_frames = True

    def __init__(
        self,
        config: BackboneConfig,
        info: SequenceInfo | None = None,
        true_depth: TrueDepth | None = None,
    ) -> None:
        self._config = config.simulated
        size = (1, 1) if info is None else self.image_size(info.size)
        self._truth = Truth(info, true_depth, size)
        self._workers = ThreadPoolExecutor(num_threads())
        self._has_warned = False
        partition = Draws(self._config.seed, 0, 1.0).common(Purpose.PARTITION)
        samples, K = self._truth.samples, self._truth.intrinsics
        upright = guess_down(self._truth.trajectory.world_from_cam)
        self._pieces = Pieces(
            self._config.object_size,
            samples.median_m,
            level_axes(settle_down(upright, samples.depths, K, samples.world_from_cam)),
            np.uint64(partition.integers(1 << 62)),
        )

    def identity(self) -> dict[str, Any]:
        """Return its settings; see `laser_slam.backbones.base.Backbone`."""
        return self._config.model_dump(mode="json")

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) of the depth maps: whole patches high, as networks want."""
        width = self._config.width
        height = round(size[0] * width / size[1] / PATCH_PX) * PATCH_PX
        return max(height, PATCH_PX), width

    def calibrate(
        self, windows: Iterable[Window], intrinsics: NDArray[np.float64] | None
    ) -> Calibration:
        """Return the given intrinsics: there is nothing to learn."""
        K = self._truth.intrinsics if intrinsics is None else intrinsics
        return Calibration(K, NO_DISTORTION, self._truth.size, "of the data set, for a simulation")

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        """Distort the truth of one window; see `laser_slam.backbones.base.Backbone`.

        Raises:
            DatasetError: the true depth of a frame cannot be read.
        """
        K = self._truth.intrinsics if intrinsics is None else intrinsics
        truth = self._truth.window(frames)
        warnings = truth.warnings if self._has_warned else (SIMULATED, *truth.warnings)
        self._has_warned = True
        shape = (len(frames), *self._truth.size)
        depth, confidence = np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32)
        window_from_cam = np.tile(np.eye(4), (len(frames), 1, 1))
        status = WindowStatus.FAILED
        if np.isfinite(truth.median_m):
            window_from_cam = self._distort(truth, frames, K, (depth, confidence))
            status = WindowStatus.OK
        tiled = np.tile(K, (len(frames), 1, 1))
        return Prediction(frames, depth, confidence, window_from_cam, tiled, status, warnings)

    def _distort(
        self, truth: WindowTruth, frames: NDArray[np.int64], K: Array, out: tuple[Map, Map]
    ) -> Array:
        """Fill (N, H, W) depth and confidence ``out``; return (N, 4, 4) window_from_cam."""
        config = self._config
        is_torn = len(frames) > 1 and int(np.diff(frames).max()) > FAR_FRAMES
        last = int(frames[-1]) if is_torn else 0
        draws = Draws(config.seed, int(frames[0]), config.persistence, last)
        unit = float(np.exp(config.scale_sigma * draws.own(Purpose.SCALE).standard_normal()))
        distortion = Distortion(config, draws)
        ground = None
        if config.layers == "objects" and config.layer_sigma > 0:
            ground = self._pieces.ground(truth.depths, K, truth.world_from_cam)

        def distort(i: int) -> Map:
            """Fill one frame; return some factors on its depth."""
            true = truth.depths[i] / np.float32(truth.median_m)
            if config.layer_sigma == 0:
                keys = None
            elif ground is None:
                keys = distortion.bands(true)
            else:
                keys = self._pieces.keys(truth.depths[i], K, truth.world_from_cam[i], ground)
            inverse = distortion.structure(true, keys)
            distortion.noise(inverse, int(frames[i]), unit, (out[0][i], out[1][i]))
            some = inverse[::STRIDE, ::STRIDE] * true[::STRIDE, ::STRIDE]
            return np.asarray(some[some > 0])

        factors = np.concatenate(list(self._workers.map(distort, range(len(frames)))))
        first_from_cam = np.linalg.inv(truth.world_from_cam[0]) @ truth.world_from_cam
        first_from_cam[:, :3, 3] /= truth.median_m
        window_from_cam = distort_poses(first_from_cam, config, draws.own(Purpose.POSES))
        window_from_cam[:, :3, 3] *= unit / float(np.median(factors))
        return window_from_cam
