"""Every setting, and how settings are read."""

from laser_slam.config.closures import ClosuresConfig
from laser_slam.config.loading import dump_config, load_config, setting_names, shipped_configs
from laser_slam.config.places import PlacesConfig, VerificationConfig
from laser_slam.config.sections import (
    BackboneConfig,
    CalibrationConfig,
    ClassicalConfig,
    Config,
    DatasetConfig,
    FusionConfig,
    LayersConfig,
    PoseGraphConfig,
    RegistrationConfig,
    RunConfig,
    SegmentationConfig,
    SyntheticConfig,
    WindowsConfig,
)
from laser_slam.config.simulated import SimulatedConfig

__all__ = [
    "BackboneConfig",
    "CalibrationConfig",
    "ClassicalConfig",
    "ClosuresConfig",
    "Config",
    "DatasetConfig",
    "FusionConfig",
    "LayersConfig",
    "PlacesConfig",
    "PoseGraphConfig",
    "RegistrationConfig",
    "RunConfig",
    "SegmentationConfig",
    "SimulatedConfig",
    "SyntheticConfig",
    "VerificationConfig",
    "WindowsConfig",
    "dump_config",
    "load_config",
    "setting_names",
    "shipped_configs",
]
