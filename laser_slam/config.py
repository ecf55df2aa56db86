"""Every setting: its default, its unit, its limits. Nowhere else."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from laser_slam.errors import ConfigError


class _Section(BaseModel):
    """A frozen group of settings that refuses unknown names."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


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
    fusion: FusionConfig = FusionConfig()
    synthetic: SyntheticConfig = SyntheticConfig()
    run: RunConfig = RunConfig()


def load_config(
    name: str | None = None, file: Path | None = None, assignments: Sequence[str] = ()
) -> Config:
    """Layer the settings: code < ``configs/<name>.yaml`` < ``file`` < ``key=value`` assignments.

    Args:
        name: of a settings file that ships with laser-slam, such as ``kitti``.
        file: a settings file of the user's.
        assignments: ``section.key=value``, the value in YAML.

    Raises:
        ConfigError: a file is missing or no YAML, a setting is unknown or out of its limits.

    >>> load_config(assignments=["windows.size=30"]).windows.size
    30
    """
    settings: dict[str, Any] = {}
    if name is not None:
        _merge(settings, _read_shipped(name))
    if file is not None:
        _merge(settings, _read_yaml(file))
    for assignment in assignments:
        _merge(settings, _parse_assignment(assignment))
    return _validate(settings)


def shipped_configs() -> Path:
    """Return the folder of the settings files that ship with laser-slam."""
    installed = Path(__file__).parent / "configs"
    return installed if installed.is_dir() else Path(__file__).parents[1] / "configs"


def dump_config(config: Config) -> str:
    """Write all settings as YAML, defaults included."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def setting_names(model: type[BaseModel] = Config, prefix: str = "") -> Iterator[str]:
    """List every setting as ``section.key``."""
    for key, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from setting_names(field.annotation, f"{prefix}{key}.")
        else:
            yield prefix + key


def _validate(settings: dict[str, Any]) -> Config:
    try:
        return Config.model_validate(settings)
    except ValidationError as error:
        raise ConfigError("; ".join(_explain(dict(item)) for item in error.errors())) from error


def _explain(item: dict[str, Any]) -> str:
    name = ".".join(str(part) for part in item["loc"])
    given = item["input"]
    if item["type"] == "extra_forbidden":
        return _explain_unknown(name, given)
    if item["type"] == "model_type":
        return f"{name}: a section needs settings below it, got {given!r}"[:300]
    text = str(item["msg"]).removeprefix("Value error, ")
    # A validator of ours has said what it got.
    got = "" if item["type"] == "value_error" else f", got {given!r}"
    return f"{name}: {text[0].lower()}{text[1:]}{got}"[:300]


def _explain_unknown(name: str, given: Any) -> str:
    while isinstance(given, dict) and len(given) > 0:
        key, given = next(iter(given.items()))
        name += f".{key}"
    known = list(setting_names())
    same_end = [other for other in known if other.endswith("." + name.rpartition(".")[2])]
    near = difflib.get_close_matches(name, known, n=1) or same_end
    return f"{name}: no such setting" + (f" (did you mean {near[0]}?)" if near else "")


def _read_shipped(name: str) -> dict[str, Any]:
    names = sorted(path.stem for path in shipped_configs().glob("*.yaml"))
    if name not in names:
        raise ConfigError(f"no settings named '{name}'; there are: {', '.join(names)}")
    return _read_yaml(shipped_configs() / f"{name}.yaml")


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read settings file {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path} must hold sections such as 'windows:', got {content!r:.60}")
    return content


def _parse_assignment(assignment: str) -> dict[str, Any]:
    name, equals, value = assignment.partition("=")
    if not equals or not all(name.strip().split(".")):
        raise ConfigError(f"--set wants section.key=value, got '{assignment}'")
    try:
        settings: Any = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise ConfigError(f"{name}: '{value}' is no YAML value") from error
    for key in reversed(name.strip().split(".")):
        settings = {key: settings}
    return dict(settings)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> None:
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            _merge(base[key], value)
        else:
            base[key] = value
