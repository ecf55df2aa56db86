"""Distorted street scenes: what layer-wise scale alignment is judged and timed on."""

from street.pairs import (
    CASES,
    KITTI_SIZE,
    OVERLAP,
    TALL_SIZE,
    WINDOW,
    Case,
    Errors,
    Pair,
    make_pair,
    rotation_error_deg,
    score,
    true_drive,
)
from street.world import GROUND, SKY, SKY_M, Drive

__all__ = [
    "CASES",
    "GROUND",
    "KITTI_SIZE",
    "OVERLAP",
    "SKY",
    "SKY_M",
    "TALL_SIZE",
    "WINDOW",
    "Case",
    "Drive",
    "Errors",
    "Pair",
    "make_pair",
    "rotation_error_deg",
    "score",
    "true_drive",
]
