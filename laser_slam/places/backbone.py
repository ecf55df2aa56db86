"""The backbone's own tokens as description of places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import ConfigError
from laser_slam.types import Prediction

BACKBONE = "backbone"  # in the settings: no descriptor of its own, but what predictions bring


def describe_by_tokens(window: Prediction, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Describe frames of a window by what the run's backbone has seen in them.

    Args:
        window: as the backbone predicted it.
        rows: (M,) which of its frames.

    Returns:
        (M, D) of unit length; zeros stay zeros.

    Raises:
        ConfigError: the backbone gives no tokens.
    """
    if window.tokens is None:
        raise ConfigError(
            "places.descriptor: this backbone has no tokens to tell places by; use vlad"
        )
    tokens = window.tokens[rows]
    length = np.linalg.norm(tokens, axis=1, keepdims=True)
    return np.asarray(tokens / np.maximum(length, 1e-12), np.float32)
