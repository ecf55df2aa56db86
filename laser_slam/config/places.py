"""The settings of place recognition."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from laser_slam.config.section import Section


class VerificationConfig(Section):
    """Whether two images show one place, by geometry."""

    width: int = Field(640, ge=160, description="images wider than this are reduced, px")
    num_features: int = Field(1000, ge=50, description="features per image")
    max_ratio: float = Field(
        0.8, gt=0, le=1, description="distance of a match over that of the second best"
    )
    max_error_px: float = Field(
        1.0, gt=0, description="distance from the epipolar line of an inlier, px at this width"
    )
    min_support: int = Field(
        30, ge=8, description="matches that agree on one motion, a few at most of each image part"
    )
    min_inlier_ratio: float = Field(
        0.5, ge=0, le=1, description="share of the matches that must agree"
    )


class PlacesConfig(Section):
    """Keyframes that may show a place seen before, and their check."""

    descriptor: str = Field(
        "vlad", description="one of laser_slam.places.DESCRIPTORS, or backbone: its own tokens"
    )
    salad_weights: str = Field("", description="weights file of 'salad', dino_salad.ckpt")
    salad_size: int = Field(
        336, ge=126, multiple_of=14, description="side of the square that 'salad' looks at, px"
    )
    salad_dtype: Literal["float32", "bfloat16"] = Field(
        "float32", description="numbers that 'salad' computes with; bfloat16: faster where AMX is"
    )
    width: int = Field(640, ge=160, description="wider images are reduced before description, px")
    num_features: int = Field(800, ge=50, description="features that a description sums up")
    min_similarity: float = Field(
        0.05, ge=-1, le=1, description="cosine, mean of the run removed, of a candidate at least"
    )
    min_contrast: float = Field(
        4.0, ge=0, description="similarity above the run's median, in the run's standard deviations"
    )
    min_gap: float = Field(
        5.0, gt=0, description="way between two visits of a place, in median depths"
    )
    suppression: float = Field(
        0.3, ge=0, description="way at both ends within which the best pair stands for all, same"
    )
    max_per_keyframe: int = Field(3, ge=1, description="places that one keyframe may be")
    max_per_window_pair: int = Field(2, ge=1, description="candidates between two windows")
    max_per_window: int = Field(6, ge=1, description="candidates of one window: bounds the time")
    verification: VerificationConfig = VerificationConfig()
