"""Every setting, and how settings are read."""

from laser_slam.config.backbones import BackboneConfig, ClassicalConfig, ReplayConfig
from laser_slam.config.closures import ClosuresConfig
from laser_slam.config.explaining import explain_config
from laser_slam.config.fusion import FusionConfig
from laser_slam.config.layers import LayersConfig, SegmentationConfig
from laser_slam.config.loading import (
    assigned,
    dump_config,
    load_config,
    setting_names,
    shipped_configs,
)
from laser_slam.config.networks import DeviceConfig, NetworkConfig, Pi3XSettings
from laser_slam.config.places import PlacesConfig, VerificationConfig
from laser_slam.config.sections import (
    CalibrationConfig,
    Config,
    DatasetConfig,
    PoseGraphConfig,
    RegistrationConfig,
    RunConfig,
    SyntheticConfig,
    WindowsConfig,
)
from laser_slam.config.simulated import SimulatedConfig
from laser_slam.config.viewer import ViewerConfig

__all__ = [
    "BackboneConfig",
    "CalibrationConfig",
    "ClassicalConfig",
    "ClosuresConfig",
    "Config",
    "DatasetConfig",
    "DeviceConfig",
    "FusionConfig",
    "LayersConfig",
    "NetworkConfig",
    "Pi3XSettings",
    "PlacesConfig",
    "PoseGraphConfig",
    "RegistrationConfig",
    "ReplayConfig",
    "RunConfig",
    "SegmentationConfig",
    "SimulatedConfig",
    "SyntheticConfig",
    "VerificationConfig",
    "ViewerConfig",
    "WindowsConfig",
    "assigned",
    "dump_config",
    "explain_config",
    "load_config",
    "setting_names",
    "shipped_configs",
]
