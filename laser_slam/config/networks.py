"""The settings of the feed-forward networks."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from laser_slam.config.section import Section


class DeviceConfig(Section):
    """Where a network computes, ours or one of somebody else's package."""

    device: str = Field("auto", description="cpu, cuda, cuda:1, mps; auto: the best that is there")


class NetworkConfig(DeviceConfig):
    """What all networks of ours have in common."""

    weights: str = Field(
        "", description="checkpoint file, .safetensors or .pt; empty: from the Hugging Face hub"
    )
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = Field(
        "auto", description="of all layers but the heads; auto: what the device is fast at"
    )
    size_rule: Literal["side", "pixels"] = Field(
        "side",
        description="side: the longer side is given, as VGGT and LASER; pixels: as Pi3's examples",
    )
    side: int = Field(518, ge=28, le=4096, multiple_of=14, description="longer side of images, px")
    num_pixels: int = Field(255_000, ge=784, description="most pixels of an image, for 'pixels'")
    chunk: int = Field(8, ge=1, description="frames that heads take at once; fewer: less memory")
    intrinsics: Literal["fitted", "given"] = Field(
        "fitted", description="of the depth maps: what the network sees, or what the data set says"
    )

    @property
    def size_limit(self) -> int:
        """Return what the size rule keeps to: the longer side in pixels, or their number."""
        return self.side if self.size_rule == "side" else self.num_pixels


class Pi3XSettings(NetworkConfig):
    """Pi3X, which is told of the camera."""

    told_intrinsics: bool = Field(True, description="known intrinsics are a prior of the network")


class DepthAnything3Config(DeviceConfig):
    """Depth Anything 3, by its authors' own package."""

    model: str = Field(
        "depth-anything/DA3-BASE", description="name on the Hugging Face hub, or a folder"
    )
    side: int = Field(504, ge=28, le=4096, multiple_of=14, description="longer side of images, px")
