"""What is logged of each frame, at its own time: camera, image, depth, confidence, layers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import resize_intrinsics
from laser_slam.config import FusionConfig, ViewerConfig
from laser_slam.dependencies import import_rerun
from laser_slam.sim3 import Sim3
from laser_slam.types import Layers, Submap
from laser_slam.viewer import arrangement as at
from laser_slam.viewer.pictures import DEPTH_STEPS, encode_depth, encode_image, layer_classes
from laser_slam.viewer.points import sample_points

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

_FRUSTUM = 0.35  # depth of the camera's frustum, in median depths
_YELLOW = (255, 200, 60)


class FrameLogger:
    """Log one frame after the other.

    Args:
        stream: rerun's.
        config: how much is shown.
        fusion: which pixels the map leaves out.
    """

    def __init__(self, stream: Any, config: ViewerConfig, fusion: FusionConfig) -> None:
        self._rerun = import_rerun()
        self._stream = stream
        self._config = config
        self._fusion = fusion
        self._window_from_cam: Array = np.eye(4)  # of the last frame

    def log(
        self, submap: Submap, layers: Layers | None, rows: Rows, times_s: Array, unit: float
    ) -> None:
        """Log some frames of a window; the last one's time is then set.

        Args:
            submap: the window.
            layers: of the window; None: they were not looked at.
            rows: of the frames.
            times_s: (N,) seconds of the window's frames.
            unit: median depth of the window, in its own unit.
        """
        for row in rows:
            self._stream.set_time(at.FRAME, sequence=int(submap.prediction.frames[row]))
            self._stream.set_time(at.TIME, duration=float(times_s[row]))
            self._window_from_cam = submap.prediction.window_from_cam[row]
            self.log_camera(submap.world_from_window)
            if row == rows[0]:
                self._log_lens(submap, int(row), unit)
            if self._config.image_width:
                self._log_pictures(submap, int(row), unit)
                self._log_layers(layers, int(row))
            if self._config.points_per_frame:
                self._log_cloud(submap, int(row), unit)

    def log_camera(self, world_from_window: Sim3) -> None:
        """Log where the last frame's camera is, now that its window is there."""
        # In the world: rerun draws no camera below a transform that scales.
        world_from_cam = world_from_window.apply_poses(self._window_from_cam)
        place = self._rerun.Transform3D(
            mat3x3=world_from_cam[:3, :3], translation=world_from_cam[:3, 3]
        )
        self._stream.log(at.CAMERA, place)

    def _log_lens(self, submap: Submap, row: int, unit: float) -> None:
        size = submap.prediction.depth.shape[1:]
        width = self._config.image_width or size[1]
        shown = (max(1, round(size[0] * width / size[1])), width)
        lens = self._rerun.Pinhole(
            image_from_camera=resize_intrinsics(submap.prediction.intrinsics[row], size, shown),
            resolution=[shown[1], shown[0]],
            image_plane_distance=_FRUSTUM * unit * submap.world_from_window.scale,
            color=_YELLOW,
        )
        self._stream.log(at.CAMERA, lens)

    def _log_pictures(self, submap: Submap, row: int, unit: float) -> None:
        rerun, width, quality = self._rerun, self._config.image_width, self._config.jpeg_quality
        image = encode_image(submap.colors[row], width, quality)
        self._stream.log(at.CAMERA, rerun.EncodedImage(contents=image, media_type="image/jpeg"))
        depth = encode_depth(submap.prediction.depth[row], width, unit)
        self._stream.log(
            at.DEPTH,
            rerun.EncodedDepthImage(
                depth,
                media_type="image/png",
                meter=DEPTH_STEPS / unit,  # so that depths read in window units
                colormap="turbo",
                depth_range=[0, DEPTH_STEPS * self._fusion.max_range],
            ),
        )
        grey = np.rint(submap.prediction.confidence[row] * 255).astype(np.uint8)
        confidence = encode_image(grey, max(1, width // 2), quality)  # it is smooth
        self._stream.log(
            at.CONFIDENCE, rerun.EncodedImage(contents=confidence, media_type="image/jpeg")
        )

    def _log_layers(self, layers: Layers | None, row: int) -> None:
        if layers is None:
            return
        scales = layers.scales[layers.starts[row] : layers.starts[row + 1]]
        classes = layer_classes(layers.labels[row], scales, self._config.image_width)
        self._stream.log(at.LAYERS, self._rerun.SegmentationImage(classes))

    def _log_cloud(self, submap: Submap, row: int, unit: float) -> None:
        points, colors = sample_points(
            submap, np.array([row]), self._config.points_per_frame, self._fusion, unit
        )
        self._stream.log(
            at.FRAME_CLOUD,
            self._rerun.CoordinateFrame(f"window {submap.index}"),
            self._rerun.Points3D(points, colors=colors, radii=-2.0),
        )
