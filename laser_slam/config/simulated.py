"""The settings of the simulated backbone: which errors of networks, and how large."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from laser_slam.config.section import Section


class SimulatedConfig(Section):
    """The truth of a data set, distorted as feed-forward networks distort it; 0: not at all.

    Sigmas of depth are standard deviations of the logarithm of its factor: 0.1 is about 10 %.
    """

    seed: int = Field(0, ge=0, description="of all errors")
    width: int = Field(518, ge=28, le=4096, description="width of the depth maps, px")
    scale_sigma: float = Field(
        0.2, ge=0, le=2, description="unit of a window around its median depth, log"
    )
    smooth_sigma: float = Field(
        0.03, ge=0, le=1, description="factor that is smooth over log depth, per window, log"
    )
    layers: Literal["bands", "objects"] = Field(
        "objects", description="what has a factor of its own: a band of log depth, or a world piece"
    )
    layer_sigma: float = Field(
        0.08, ge=0, le=1, description="factor of each layer, per window, log"
    )
    layer_law: Literal["uniform", "normal"] = Field(
        "uniform", description="law of the logarithm of the layers' factors"
    )
    band_width: float = Field(0.4, gt=0, description="width of 'bands' in log depth")
    object_size: float = Field(
        0.5, gt=0, description="width of 'objects', in median depths of the sequence"
    )
    persistence: float = Field(
        0.5, ge=0, le=1, description="share of the depth errors' variance that all windows share"
    )
    noise_smooth: float = Field(0.02, ge=0, le=1, description="smooth noise of each frame, log")
    noise_px: float = Field(30.0, ge=4, description="distance over which smooth noise changes, px")
    noise_iid: float = Field(0.005, ge=0, le=1, description="noise of each pixel, log")
    edge_blur_px: float = Field(1.0, ge=0, le=20, description="blur of depth edges, sigma in px")
    blob_share: float = Field(
        0.01, ge=0, le=0.9, description="share of a frame's pixels in blobs of wrong depth"
    )
    blob_told: float = Field(
        0.5, ge=0, le=1, description="confidence that blobs lack; 1: all, 0: they look like others"
    )
    confidence_told: float = Field(
        0.8, ge=0, le=1, description="how well confidence knows of edges, distance and noise"
    )
    pose_rotation_deg: float = Field(
        0.1, ge=0, le=30, description="rotation noise of each frame, rms, degrees"
    )
    pose_translation: float = Field(
        0.003, ge=0, le=1, description="position noise of each frame, rms, in median depths"
    )
    drift_rotation_deg: float = Field(
        0.05, ge=0, le=10, description="turn from frame to frame, one for a window, rms, degrees"
    )
    drift_translation: float = Field(
        0.02, ge=0, le=1, description="slip from frame to frame, one for a window, rms, of a step"
    )
