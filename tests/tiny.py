"""Networks of a tiny shape, with weights drawn from their names."""

from __future__ import annotations

import golden
import numpy as np
from torch import nn

from laser_slam.camera import intrinsics_from_fov
from laser_slam.networks.camera_head import CameraHeadConfig
from laser_slam.networks.dinov2 import EncoderConfig
from laser_slam.networks.dpt import DptConfig
from laser_slam.networks.metric import MetricConfig
from laser_slam.networks.pi3 import Pi3Config
from laser_slam.networks.pi3x import Pi3X, Pi3XConfig
from laser_slam.networks.vggt import Vggt, VggtConfig
from laser_slam.types import Image

ENCODER = EncoderConfig(64, 2, 2, num_registers=4)
TINY = Pi3Config(ENCODER, depth=4, num_heads=2, head_depth=2, camera_width=32)
SIZE = (70, 126)
FRAMES = np.arange(3, 7)
K = intrinsics_from_fov(80.0, *SIZE)
GIVEN = "backbone.pi3.intrinsics=given"  # random weights agree on no camera


def make_pi3x() -> nn.Module:
    return Pi3X(
        Pi3XConfig(
            ENCODER,
            depth=4,
            num_heads=2,
            head_depth=2,
            camera_width=32,
            depth_encoder=EncoderConfig(64, 2, 2, num_registers=4, channels=2),
            channels=(64, 32, 32),
            metric=MetricConfig(width=32, depth=1, num_heads=2),
            injected_after=(1,),
        )
    )


def make_vggt() -> nn.Module:
    shape = VggtConfig(
        ENCODER,
        depth=4,
        num_heads=2,
        levels=(0, 1, 2, 3),
        dense=DptConfig((16, 32, 64, 64), 32),
        camera=CameraHeadConfig(2, 2),
    )
    return Vggt(shape)


def images(count: int = len(FRAMES)) -> list[Image]:
    frames = golden.make_images(5, count, *SIZE)
    return [np.asarray(np.round(frame.transpose(1, 2, 0) * 255), np.uint8) for frame in frames]
