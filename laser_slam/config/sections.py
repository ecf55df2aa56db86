"""Every setting: its default, its unit, its limits. Nowhere else."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from laser_slam.config.backbones import BackboneConfig
from laser_slam.config.closures import ClosuresConfig
from laser_slam.config.export import ExportConfig
from laser_slam.config.fusion import FusionConfig
from laser_slam.config.layers import LayersConfig
from laser_slam.config.places import PlacesConfig
from laser_slam.config.section import Section as _Section
from laser_slam.config.viewer import ViewerConfig

MIN_WINDOW = 3  # keyframes


def _zero_if_auto(value: object) -> object:
    return 0 if value == "auto" else value


class DatasetConfig(_Section):
    """The input, where the material itself does not say."""

    fps: float = Field(10.0, gt=0, description="frames per second of images without times")
    stride: int = Field(1, ge=1, description="every so many-th frame of a video is read")


class WindowsConfig(_Section):
    """Keyframes and overlapping windows."""

    size: Annotated[int, BeforeValidator(_zero_if_auto)] = Field(
        20, ge=0, description="keyframes per window, 3 or more; auto: what memory allows"
    )
    overlap: int = Field(5, ge=1, description="keyframes shared by neighbouring windows")
    min_parallax_px: float = Field(
        1.5, ge=0, description="motion that makes a keyframe, rotation removed; px at 640 wide"
    )
    max_flow_px: float = Field(
        40.0, gt=0, description="motion with rotation that makes a keyframe anyway; px at 640 wide"
    )

    @model_validator(mode="after")
    def _overlap_leaves_new_frames(self) -> Self:
        if 0 < self.size < MIN_WINDOW:
            raise ValueError(f"size ({self.size}) must be {MIN_WINDOW} or more, or auto")
        if self.size and self.overlap >= self.size:
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


class RegistrationConfig(_Section):
    """The Sim(3) between neighbouring windows."""

    scale: Literal["log_huber", "huber", "l1", "closed_form"] = Field(
        "log_huber", description="estimator of the scale; closed_form: the paper's 'w/o IRLS'"
    )
    rigid: Literal["anchors", "points", "joint"] = Field(
        "anchors",
        description="what gives rotation and translation; points: 'w/o Anchor'; joint: points "
        "give the scale as well, all at once, as VGGT-Long",
    )
    huber_delta: float = Field(
        0.1, gt=0, description="where 'huber' and 'joint' bend, in median ranges of the pixels"
    )
    anchor_length: Literal["balanced", "spread", "unit"] = Field(
        "balanced",
        description="length of the anchors' axes: noise of the centres over noise of the axes, "
        "spread of the centres, or the paper's 1",
    )
    min_pixels: int = Field(100, ge=10, description="confident pixels that the scale needs")


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

    preset: str = Field("", description="shipped settings that lie under all that are given")
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
    export: ExportConfig = ExportConfig()
    viewer: ViewerConfig = ViewerConfig()
    synthetic: SyntheticConfig = SyntheticConfig()
    run: RunConfig = RunConfig()

    @property
    def has_layers(self) -> bool:
        """Tell whether layers are aligned: auto means for every backbone but ``classical``."""
        if self.layers.enabled == "auto":
            return self.backbone.origin != "classical"
        return self.layers.enabled == "always"

    @property
    def smooths_layers(self) -> bool:
        """Tell whether layers are passed over a second time, backwards."""
        return self.has_layers and self.layers.smooth and self.layers.memory > 0
