"""What backbones that are one pass of a network have in common.

No PyTorch is imported here but inside of functions.
"""

from laser_slam.backbones.feedforward.backbone import NetworkBackbone
from laser_slam.backbones.feedforward.camera import fit_camera, take_calibration, window_camera
from laser_slam.backbones.feedforward.sizes import network_size
from laser_slam.backbones.feedforward.view import View, inverted, to_prediction
from laser_slam.backbones.feedforward.window import fitting_window

__all__ = [
    "NetworkBackbone",
    "View",
    "fit_camera",
    "fitting_window",
    "inverted",
    "network_size",
    "take_calibration",
    "to_prediction",
    "window_camera",
]
