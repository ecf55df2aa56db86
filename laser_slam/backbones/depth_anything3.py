"""Depth Anything 3 by its authors' own package: how a model of others becomes a backbone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.feedforward import (
    View,
    inverted,
    network_size,
    take_calibration,
    to_prediction,
    window_camera,
)
from laser_slam.config import BackboneConfig
from laser_slam.dependencies import import_torch
from laser_slam.errors import DependencyError, WeightsError
from laser_slam.types import Calibration, Image, Prediction, Window

FORMAT = 1  # rises when the same model makes other predictions of the same images


class DepthAnything3Backbone:
    """Depth Anything 3 (arXiv:2511.10647); the package is not part of laser-slam.

    Attributes:
        remembers: False, see `laser_slam.backbones.base.Backbone`.
        sees_far_frames: True, same.

    Args:
        config: which model, and where it computes.
        model: one that is used as it is; None: the one that the settings name.

    Raises:
        ConfigError: the device is not there.
        DependencyError: the package is not installed.
        WeightsError: the model cannot be downloaded or read.
    """

    remembers = False
    sees_far_frames = True

    def __init__(self, config: BackboneConfig, model: Any = None) -> None:
        self._config = config.depth_anything3
        self._model = _load(self._config.model, self._config.device) if model is None else model

    def identity(self) -> dict[str, Any]:
        """Return model and size; see `laser_slam.backbones.base.Backbone`."""
        config = self._config
        return {"model": config.model, "size": {"side": config.side}, "format": FORMAT}

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) that the package would make of (height, width) ``size``."""
        return network_size(size, "side", self._config.side)

    def calibrate(
        self, windows: Iterable[Window], intrinsics: NDArray[np.float64] | None
    ) -> Calibration:
        """Return what was given: the model finds its own camera for each window."""
        return take_calibration(windows, intrinsics, "Depth Anything 3")

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        """Predict one window; see `laser_slam.backbones.base.Backbone`.

        Raises:
            WeightsError: the model is one for single images, which gives no poses.
        """
        seen = self._model.inference(list(images), process_res=self._config.side)
        if seen.extrinsics is None or seen.intrinsics is None or seen.conf is None:
            raise WeightsError(
                f"backbone.depth_anything3.model: {self._config.model} gives no poses; "
                "take one for any number of views, such as depth-anything/DA3-BASE"
            )
        cam_from_world = np.tile(np.eye(4), (len(frames), 1, 1))
        cam_from_world[:, :3] = seen.extrinsics[:, :3]  # OpenCV's axes, as ours
        view = View(
            np.asarray(seen.depth, np.float32),
            np.asarray(1 - 1 / np.maximum(seen.conf, 1), np.float32),  # 1 and more, as VGGT's
            inverted(cam_from_world),
            window_camera(np.asarray(seen.intrinsics, np.float64)),
        )
        return to_prediction(view, frames)


def _load(name: str, device: str) -> Any:
    import_torch()
    from laser_slam.networks.placement import choose_placement  # noqa: PLC0415  (needs torch)

    chosen = choose_placement(device, "float32", "backbone.depth_anything3").device
    try:
        package = import_module("depth_anything_3.api")  # not everyone has it
    except ImportError as error:
        raise DependencyError(
            f"backbone.name: depth_anything3 needs its authors' package ({error}); install it: "
            "pip install git+https://github.com/ByteDance-Seed/Depth-Anything-3"
        ) from error
    try:
        model = package.DepthAnything3.from_pretrained(name)
    except (OSError, ValueError, RuntimeError) as error:
        first = str(error).strip().splitlines()[0][:120] if str(error).strip() else "no reason"
        raise WeightsError(
            f"backbone.depth_anything3.model: '{name}' cannot be had ({first}); give a folder "
            "that holds its config.json and model.safetensors, or a name on the Hugging Face hub"
        ) from error
    return model.to(chosen).eval()
