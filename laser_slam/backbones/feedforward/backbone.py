"""What backbones that are one pass of a network do alike."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones.feedforward.camera import take_calibration
from laser_slam.backbones.feedforward.sizes import network_size
from laser_slam.backbones.feedforward.view import View, blind_view, to_prediction
from laser_slam.config.networks import NetworkConfig
from laser_slam.dependencies import import_torch
from laser_slam.errors import ConfigError
from laser_slam.types import Calibration, Image, Prediction, Window

if TYPE_CHECKING:
    from pathlib import Path

    from torch import Tensor

    from laser_slam.networks.weights import Checkpoint

FORMAT = 1  # rises when the same network makes other predictions of the same images


class NetworkBackbone(ABC):
    """A frozen network: all images of a window in, depth and poses out, in one pass.

    What is wrong with settings, device or weights is said at once; the weights are read when the
    first window is predicted, so that a run whose windows are all stored never reads them.

    Args:
        config: of this network.
        network: a network that is used as it is, instead of weights from a file; None: those.

    Attributes:
        name: of the network, as in the settings.
        remembers: False, see `laser_slam.backbones.base.Backbone`.
        sees_far_frames: True, same.

    Raises:
        ConfigError: the device is not there.
        DependencyError: PyTorch is not installed.
        WeightsError: the weights are not there and cannot be had.
    """

    name: ClassVar[str]
    remembers = False
    sees_far_frames = True

    def __init__(self, config: NetworkConfig, network: Any = None) -> None:
        import_torch()
        from laser_slam.networks.hub import find_weights  # noqa: PLC0415  (needs torch)
        from laser_slam.networks.placement import choose_placement  # noqa: PLC0415

        self._config = config
        self._placement = choose_placement(config.device, config.dtype, f"backbone.{self.name}")
        self._given = network
        self._one_at_a_time = threading.Lock()  # windows of loops come from another thread
        self._weights = None
        if network is None:
            self._weights = find_weights(config.weights, self._checkpoint())

    @abstractmethod
    def _checkpoint(self) -> Checkpoint:
        """Return where the weights come from."""

    @abstractmethod
    def _load(self, weights: Path) -> Any:
        """Read the network from its file."""

    @abstractmethod
    def _view(self, network: Any, images: Tensor, intrinsics: NDArray[np.float64] | None) -> View:
        """Run the network on (1, N, 3, H, W) images in [0, 1] and read its outputs.

        Args:
            network: on the device.
            images: on the device.
            intrinsics: (3, 3) in pixels of these images; None: unknown.
        """

    def identity(self) -> dict[str, Any]:
        """Return network, checkpoint and settings; see `laser_slam.backbones.base.Backbone`.

        The device is none of it, but what it computes in is.
        """
        return {
            "network": self.name,
            "checkpoint": self._hash,
            "dtype": self._placement.dtype_name,
            "size": {self._config.size_rule: self._config.size_limit},
            "intrinsics": self._config.intrinsics,
            "format": FORMAT,
        }

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) at which it wants images of (height, width) ``size``."""
        return network_size(size, self._config.size_rule, self._config.size_limit)

    def calibrate(
        self, windows: Iterable[Window], intrinsics: NDArray[np.float64] | None
    ) -> Calibration:
        """Return what was given: the network finds its own camera for each window.

        Raises:
            DegenerateGeometryError: there is no window.
        """
        uses = self._config.intrinsics == "given"
        return take_calibration(windows, intrinsics, self.name, is_used=uses)

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        """Predict one window; see `laser_slam.backbones.base.Backbone`.

        Raises:
            ConfigError: the window is too large for the device's memory, or the depth maps are to
                have given intrinsics and there are none.
            WeightsError: the weights cannot be read or are of another network.
        """
        if self._config.intrinsics == "given" and intrinsics is None:
            raise ConfigError(
                f"backbone.{self.name}.intrinsics: 'given', but this input has none; "
                "give them, or use 'fitted'"
            )
        with self._one_at_a_time:
            view = self._see(np.stack(images), intrinsics)
        return to_prediction(view, frames)

    def _see(self, pixels: NDArray[np.uint8], intrinsics: NDArray[np.float64] | None) -> View:
        """Run the network on (N, H, W, 3) pixels."""
        network = self._network
        free_bytes = self._placement.free_bytes()
        try:
            with self._placement.computing():
                return self._view(network, self._placement.upload(pixels), intrinsics)
        except RuntimeError as error:
            return self._after(error, pixels.shape, free_bytes)

    def _after(self, error: RuntimeError, shape: tuple[int, ...], free_bytes: int) -> View:
        """Say what to do where memory was too short for images of ``shape``.

        Returns:
            A view of nothing, where numbers have overflowed inside of the network.
        """
        from laser_slam.networks.memory import Request, advise  # noqa: PLC0415
        from laser_slam.networks.placement import is_out_of_memory, is_overflow  # noqa: PLC0415

        if is_overflow(error):
            return blind_view((shape[0], shape[1], shape[2]))
        if not is_out_of_memory(error):
            raise error
        request = Request(
            self.name, (shape[1], shape[2]), self._placement.dtype_name, self._config.chunk
        )
        advice = advise(request, shape[0], free_bytes, f"backbone.{self.name}")
        raise ConfigError(advice) from error

    @cached_property
    def _network(self) -> Any:
        from laser_slam.networks.memory import Request  # noqa: PLC0415
        from laser_slam.networks.placement import is_out_of_memory  # noqa: PLC0415

        network = self._given if self._weights is None else self._load(self._weights)
        try:
            return network.to(self._placement.device)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            size = Request(self.name, (1, 1), self._placement.dtype_name).weights_bytes() / 1e9
            section = f"backbone.{self.name}"
            raise ConfigError(
                f"no memory for the weights of {self.name} on {self._placement.device}, "
                f"{size:.1f} GB: set {section}.dtype=bfloat16 or {section}.device=cpu"
            ) from error

    @cached_property
    def _hash(self) -> str:
        from laser_slam.networks.hub import hash_file, hash_weights  # noqa: PLC0415

        if self._weights is None:
            return hash_weights(self._given)
        return hash_file(self._weights)
