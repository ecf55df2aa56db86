"""Places: keyframes that may show what was seen before, and the check of the two images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from laser_slam.dependencies import import_named
from laser_slam.places.backbone import BACKBONE, describe_by_tokens
from laser_slam.places.candidates import Candidate, CandidateSearch, Place
from laser_slam.places.index import PlaceIndex
from laser_slam.places.verification import Features, Verification, find_features, verify

if TYPE_CHECKING:
    from laser_slam.config import PlacesConfig
    from laser_slam.places.base import Descriptor

__all__ = [
    "BACKBONE",
    "DESCRIPTORS",
    "Candidate",
    "CandidateSearch",
    "Features",
    "Place",
    "PlaceIndex",
    "Verification",
    "describe_by_tokens",
    "find_features",
    "make_descriptor",
    "verify",
]

DESCRIPTORS = {
    "vlad": "laser_slam.places.vlad:VladDescriptor",
    "salad": "laser_slam.places.salad:SaladDescriptor",
}
"""Name in the settings -> ``module:Class``, imported on use."""


def make_descriptor(config: PlacesConfig) -> Descriptor:
    """Import and build the descriptor that the settings name.

    Raises:
        ConfigError: no descriptor has this name.
    """
    chosen = import_named(DESCRIPTORS, config.descriptor, "places.descriptor", [BACKBONE])
    descriptor: Descriptor = chosen(config)
    return descriptor
