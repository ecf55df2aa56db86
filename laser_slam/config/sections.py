"""Every setting: its default, its unit, its limits. Nowhere else."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from laser_slam.config.closures import ClosuresConfig
from laser_slam.config.places import PlacesConfig
from laser_slam.config.section import Section as _Section
from laser_slam.config.simulated import SimulatedConfig


class DatasetConfig(_Section):
    """The input, where the material itself does not say."""

    fps: float = Field(10.0, gt=0, description="frames per second of images without times")
    stride: int = Field(1, ge=1, description="every so many-th frame of a video is read")


class WindowsConfig(_Section):
    """Keyframes and overlapping windows."""

    size: int = Field(20, ge=3, description="keyframes per window")
    overlap: int = Field(5, ge=1, description="keyframes shared by neighbouring windows")
    min_parallax_px: float = Field(
        1.5, ge=0, description="motion that makes a keyframe, rotation removed; px at 640 wide"
    )
    max_flow_px: float = Field(
        40.0, gt=0, description="motion with rotation that makes a keyframe anyway; px at 640 wide"
    )

    @model_validator(mode="after")
    def _overlap_leaves_new_frames(self) -> Self:
        if self.overlap >= self.size:
            raise ValueError(
                f"overlap ({self.overlap}) must be smaller than size ({self.size}): "
                "lower windows.overlap or raise windows.size"
            )
        return self


class CalibrationConfig(_Section):
    """What the run learns of the camera before it starts."""

    keyframes: int = Field(
        480, ge=0, description="first keyframes that calibrate the camera; 0: taken as given"
    )


class ClassicalConfig(_Section):
    """The default backbone: tracks, bundle adjustment, plane sweep; on the CPU."""

    max_width: int = Field(1280, ge=160, description="images wider than this are reduced, px")
    track_width: int = Field(640, ge=160, description="width at which corners are tracked, px")
    track_patch: int = Field(15, ge=5, le=31, description="side of the tracked patch, px")
    num_features: int = Field(1000, ge=100, description="corners per frame")
    max_backward_px: float = Field(0.7, gt=0, description="forward-backward gap of a good track")
    refine_radius: int = Field(
        5, ge=0, le=10, description="half side of aligned patches, px at 1280 wide; 0: none are"
    )
    context: int = Field(15, ge=0, description="earlier keyframes that steady a window's solution")
    depth_width: int = Field(640, ge=96, description="width of the depth maps, px")
    num_planes: int = Field(64, ge=16, le=256, description="inverse depths that are tried")


class BackboneConfig(_Section):
    """The source of depth, poses and confidence."""

    name: str = Field("classical", description="one of the names in laser_slam.backbones.BACKBONES")
    classical: ClassicalConfig = ClassicalConfig()
    simulated: SimulatedConfig = SimulatedConfig()


class RegistrationConfig(_Section):
    """The Sim(3) between neighbouring windows."""

    scale: Literal["log_huber", "huber", "l1", "closed_form"] = Field(
        "log_huber", description="estimator of the scale; closed_form: the paper's 'w/o IRLS'"
    )
    rigid: Literal["anchors", "points"] = Field(
        "anchors", description="what gives rotation and translation; points: 'w/o Anchor'"
    )
    huber_delta: float = Field(
        0.1, gt=0, description="where 'huber' bends, in median ranges of the shared pixels"
    )
    anchor_length: Literal["balanced", "spread", "unit"] = Field(
        "balanced",
        description="length of the anchors' axes: noise of the centres over noise of the axes, "
        "spread of the centres, or the paper's 1",
    )
    min_pixels: int = Field(100, ge=10, description="confident pixels that the scale needs")


class SegmentationConfig(_Section):
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


class LayersConfig(_Section):
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


class PoseGraphConfig(_Section):
    """The places of all windows, from registrations and closures."""

    robust: bool = Field(
        True, description="closures may be left out; false: all are right, plain least squares"
    )
    inlier_probability: float = Field(
        0.9999, gt=0.5, lt=1, description="share of right closures that pass the chi-square test"
    )
    cauchy_width: float = Field(
        1.0, gt=0, description="misfit, in sigmas, beyond which the kernel doubts a closure"
    )
    max_stretch: float = Field(
        10.0,
        ge=1,
        description="how many times its sigmas the chain may err where closures agree on it",
    )
    max_iterations: int = Field(100, ge=1, description="of one run of the solver")


class FusionConfig(_Section):
    """Submaps to one coloured cloud."""

    min_confidence: float = Field(0.5, ge=0, le=1, description="pixels below it stay out")
    max_range: float = Field(
        3.0, gt=0, description="depth beyond which pixels stay out, in median depths of the window"
    )
    edge_jump: float = Field(
        0.05, gt=0, description="depth step between neighbours that makes an edge, in its depth"
    )
    stride: int = Field(1, ge=1, description="every so many-th row and column is used")
    voxel_size: float = Field(
        0.0, ge=0, description="edge of the averaging voxels in world units; 0: auto_voxel decides"
    )
    auto_voxel: float = Field(
        0.006, gt=0, description="edge of the voxels, in median depths of the first good window"
    )
    min_observations: int = Field(
        8, ge=1, description="views that a voxel and its 26 neighbours need in sum; fewer: noise"
    )


class SyntheticConfig(_Section):
    """The generated drive."""

    num_frames: int = Field(240, ge=2, description="frames")
    step_m: float = Field(0.9, gt=0, le=5, description="mean distance between frames, metres")
    width: int = Field(640, ge=64, le=4096, description="image width, px")
    height: int = Field(192, ge=32, le=4096, description="image height, px")
    focal: float = Field(0.58, ge=0.2, le=3, description="focal length, in image widths")
    seed: int = Field(0, ge=0, description="of path, world and noise")
    noise: float = Field(1.5, ge=0, le=50, description="sensor noise, grey levels of 255")
    haze: float = Field(0.0028, ge=0, le=0.1, description="light lost to the haze, per metre")


class RunConfig(_Section):
    """The run itself."""

    samples: int = Field(
        20, ge=1, description="keyframes whose depth is scored and drawn, spread over the run"
    )


class Config(_Section):
    """All settings of a run."""

    dataset: DatasetConfig = DatasetConfig()
    windows: WindowsConfig = WindowsConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    backbone: BackboneConfig = BackboneConfig()
    registration: RegistrationConfig = RegistrationConfig()
    layers: LayersConfig = LayersConfig()
    places: PlacesConfig = PlacesConfig()
    closures: ClosuresConfig = ClosuresConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    fusion: FusionConfig = FusionConfig()
    synthetic: SyntheticConfig = SyntheticConfig()
    run: RunConfig = RunConfig()

    @property
    def has_layers(self) -> bool:
        """Tell whether layers are aligned: auto means for every backbone but ``classical``."""
        if self.layers.enabled == "auto":
            return self.backbone.name != "classical"
        return self.layers.enabled == "always"

    @property
    def smooths_layers(self) -> bool:
        """Tell whether layers are passed over a second time, backwards."""
        return self.has_layers and self.layers.smooth and self.layers.memory > 0
