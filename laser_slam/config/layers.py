"""The settings of layer-wise scale alignment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from laser_slam.config.section import Section


class SegmentationConfig(Section):
    """Depth maps to layers."""

    segmenter: str = Field(
        "felzenszwalb", description="one of the names in laser_slam.layers.SEGMENTERS"
    )
    downscale: int = Field(
        2, ge=1, le=8, description="layers are found on every so many-th row and column"
    )
    depth: Literal["log", "inverse", "linear"] = Field(
        "log",
        description="what is segmented; linear: raw depth, whose layers depend on its unit",
    )
    scale: float = Field(
        30.0, gt=0, description="255 k of Felzenszwalb's threshold k / size: larger, fewer layers"
    )
    sigma: float = Field(1.2, ge=0, le=20, description="blur before, in px of the depth map")
    min_share: float = Field(
        0.002, ge=0, le=1, description="smaller layers join a neighbour, share of the image's area"
    )
    min_size_px: int = Field(
        0, ge=0, description="the same in px of the depth map; 0: min_share decides"
    )
    merge: float = Field(
        0.0, ge=0, lt=1, description="neighbours closer than this share of the window's range join"
    )
    merge_rule: Literal["robust", "range"] = Field(
        "robust",
        description="robust: 2..98 % of the values, means follow; range: max - min of the "
        "confident ones, chained as in the official code",
    )
    label_folder: str = Field(
        "", description="label maps of 'label_files', named by frame: 000012.png or .npy"
    )
    sam2_config: str = Field(
        "configs/sam2.1/sam2.1_hiera_l.yaml", description="model settings of 'sam2'"
    )
    sam2_checkpoint: str = Field("", description="weights file of 'sam2', a .pt")


class LayersConfig(Section):
    """Layer-wise scale alignment."""

    enabled: Literal["auto", "always", "never"] = Field(
        "auto", description="auto: for backbones whose depth it improves"
    )
    segmentation: SegmentationConfig = SegmentationConfig()
    tau_inter: float = Field(
        0.1, ge=0, lt=1, description="IoU above which layers of two windows are linked"
    )
    tau_intra: float = Field(
        0.1, ge=0, lt=1, description="IoU above which layers of consecutive frames are linked"
    )
    intra: bool = Field(True, description="scales go on from frame to frame; false: 'w/o intra'")
    follow: bool = Field(
        True, description="layers are carried along by depth and poses; false: the same pixels"
    )
    scale: Literal["median", "huber", "l1", "closed_form"] = Field(
        "median", description="estimator of a layer's scale; huber: the paper's, in metric depth"
    )
    confidence: bool = Field(True, description="pixels weigh by their confidence; false: all alike")
    shrink: bool = Field(
        True,
        description="what noise explains is no scale, and what depth explains is a curve over it; "
        "false: each layer's scale as measured",
    )
    curve: bool = Field(True, description="with shrink: scales may follow a curve over log depth")
    memory: int = Field(
        20, ge=0, description="windows whose opinions a scale averages; 0: the one before is right"
    )
    feed_back: bool = Field(
        False, description="the next window is registered to corrected depth, as the official code"
    )
    smooth: bool = Field(
        True, description="with memory: a second pass, backwards, for what later windows say"
    )
    min_support: float = Field(
        3e-4, ge=0, le=1, description="share of the image that a measured scale needs"
    )
    max_spread: float = Field(
        0.15, gt=0, description="standard deviation of log-ratios in a layer; more: no one scale"
    )
    max_scale: float = Field(1.6, gt=1, description="scales beyond it, or its inverse, are refused")
    feather: float = Field(
        16, ge=0, description="px over which scales blend where a surface goes on; 0: not at all"
    )
