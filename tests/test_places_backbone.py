"""Places told apart by the backbone's own tokens."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corridor import SIZE, Corridor, TrueBackbone, true_prediction
from numpy.typing import NDArray

from laser_slam.config import load_config
from laser_slam.errors import ConfigError
from laser_slam.pipeline import Pipeline
from laser_slam.places import describe_by_tokens
from laser_slam.store import load_prediction, save_prediction
from laser_slam.types import Prediction

FRAMES = np.arange(6)
COLORS = np.zeros((len(FRAMES), *SIZE, 3), np.uint8)
SETTINGS = ["places.descriptor=backbone", "windows.size=8"]


def with_tokens(prediction: Prediction) -> Prediction:
    """Give each frame a token that is its own for good."""
    rows = [np.random.default_rng(int(frame)).normal(size=32) for frame in prediction.frames]
    return replace(prediction, tokens=np.array(rows, np.float32))


class BackboneWithTokens(TrueBackbone):
    def predict(self, images: Any, frames: Any, intrinsics: Any) -> Prediction:
        return with_tokens(super().predict(images, frames, intrinsics))


def test_tokens_become_unit_vectors_and_nothing_stays_nothing() -> None:
    window = with_tokens(true_prediction(FRAMES))
    assert window.tokens is not None
    window.tokens[2] = 0
    described = describe_by_tokens(window, np.array([0, 2, 5]))
    np.testing.assert_allclose(np.linalg.norm(described, axis=1), [1, 0, 1], atol=1e-6)
    last = window.tokens[5]
    np.testing.assert_allclose(described[2] * np.linalg.norm(last), last, rtol=1e-5)


def test_tokens_survive_the_disk(tmp_path: Path) -> None:
    window = with_tokens(true_prediction(FRAMES))
    kept, _ = save_prediction(tmp_path / "with.npz", window, COLORS)
    loaded, _ = load_prediction(tmp_path / "with.npz")
    for one in (kept, loaded):
        assert one.tokens is not None
        np.testing.assert_array_equal(one.tokens, window.tokens)
    save_prediction(tmp_path / "without.npz", true_prediction(FRAMES), COLORS)
    assert load_prediction(tmp_path / "without.npz")[0].tokens is None


@pytest.mark.parametrize("wrong", [np.zeros((5, 3)), np.zeros(6), np.full((6, 2), np.nan)])
def test_tokens_must_be_one_finite_vector_a_frame(wrong: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match=r"tokens must be \(6, D\)"):
        replace(true_prediction(FRAMES), tokens=wrong.astype(np.float32))


def test_a_run_tells_places_by_the_tokens_of_its_backbone(tmp_path: Path) -> None:
    backbone = BackboneWithTokens()
    run = Pipeline(Corridor(), load_config(assignments=SETTINGS), tmp_path / "r", backbone=backbone)
    assert run.run().report["closures"]["candidates"] == 0  # no two frames have like tokens
    assert (tmp_path / "r/pictures/similarity.png").exists()


def test_a_backbone_without_tokens_is_refused_in_one_line(tmp_path: Path) -> None:
    config = load_config(assignments=SETTINGS)
    run = Pipeline(Corridor(), config, tmp_path / "r", backbone=TrueBackbone())
    with pytest.raises(ConfigError, match="has no tokens to tell places by; use vlad"):
        run.run()
