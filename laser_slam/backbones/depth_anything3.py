"""Depth Anything 3 by its authors' own package: how a model of others becomes a backbone."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module, metadata
from pathlib import Path
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

PACKAGE = "depth-anything-3"
WEIGHTS = "model.safetensors"
FORMAT = 1  # rises when the same model makes other predictions of the same images


class DepthAnything3Backbone:
    """Depth Anything 3 (arXiv:2511.10647); the package is not part of laser-slam.

    What is wrong with device or package is said at once; the model is read when the first window
    is predicted.

    Attributes:
        remembers: False, see `laser_slam.backbones.base.Backbone`.
        sees_far_frames: True, same.

    Args:
        config: which model, and where it computes.
        model: one that is used as it is; None: the one that the settings name.

    Raises:
        ConfigError: the device is not there.
        DependencyError: the package is not installed.
    """

    remembers = False
    sees_far_frames = True

    def __init__(self, config: BackboneConfig, model: Any = None) -> None:
        torch = import_torch()
        from laser_slam.networks.placement import choose_placement  # noqa: PLC0415  (needs torch)

        self._config = config.depth_anything3
        self._device = choose_placement(
            self._config.device, "float32", "backbone.depth_anything3"
        ).device
        # The package's own rule, on every device.
        is_new = torch.cuda.is_available() and torch.cuda.is_bf16_supported()
        self._dtype = "bfloat16" if is_new else "float16"
        self._given = model
        self._package = None if model is not None else _import_package()
        self._one_at_a_time = threading.Lock()  # windows of loops come from another thread

    def identity(self) -> dict[str, Any]:
        """Return package, model and size; see `laser_slam.backbones.base.Backbone`.

        Raises:
            WeightsError: the model is not here, and the hub does not say which one it would be.
        """
        config = self._config
        return {
            "model": config.model,
            "revision": self._revision,
            "package": _package_version(),
            "dtype": self._dtype,
            "size": {"side": config.side},
            "format": FORMAT,
        }

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
            WeightsError: the model cannot be downloaded or read, or is one for single images,
                which gives no poses.
        """
        with self._one_at_a_time:
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

    @cached_property
    def _model(self) -> Any:
        if self._package is None:
            return self._given
        name, revision = self._config.model, self._revision
        folder = Path(name).expanduser()
        with _told_as_weights_error(name):
            which = (str(folder), None) if folder.is_dir() else (name, revision)
            model = self._package.DepthAnything3.from_pretrained(which[0], revision=which[1])
        return model.to(self._device).eval()

    @cached_property
    def _revision(self) -> str:
        """The commit of the model on the hub, the hash of a folder's file; empty: was given."""
        if self._package is None:
            return ""
        from laser_slam.networks.hub import hash_file  # noqa: PLC0415  (needs torch)

        folder = Path(self._config.model).expanduser()
        with _told_as_weights_error(self._config.model):
            return hash_file(folder / WEIGHTS) if folder.is_dir() else _commit(self._config.model)


def _import_package() -> Any:
    try:
        return import_module("depth_anything_3.api")  # not everyone has it
    except ImportError as error:
        raise DependencyError(
            f"backbone.name: depth_anything3 needs its authors' package ({error}); install it: "
            "pip install git+https://github.com/ByteDance-Seed/Depth-Anything-3"
        ) from error


def _package_version() -> str:
    """Return version and commit: its authors count no versions."""
    try:
        found = metadata.distribution(PACKAGE)
    except metadata.PackageNotFoundError:
        return "unknown"
    origin = json.loads(found.read_text("direct_url.json") or "{}")  # what pip was told
    commit = origin.get("vcs_info", {}).get("commit_id", "")
    return f"{found.version} {commit}".strip()


def _commit(repo: str) -> str:
    """Return which commit of a repository on the hub is on this machine, else the newest."""
    from huggingface_hub import hf_hub_download  # noqa: PLC0415  (it comes with the package)

    try:
        file = hf_hub_download(repo, "config.json", local_files_only=True)
    except FileNotFoundError:
        file = hf_hub_download(repo, "config.json")
    return Path(file).parent.name  # snapshots/<commit>/config.json


@contextmanager
def _told_as_weights_error(name: str) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, RuntimeError) as error:
        first = str(error).strip().splitlines()[0][:120] if str(error).strip() else "no reason"
        raise WeightsError(
            f"backbone.depth_anything3.model: '{name}' cannot be had ({first}); give a folder "
            "that holds its config.json and model.safetensors, or a name on the Hugging Face hub"
        ) from error
