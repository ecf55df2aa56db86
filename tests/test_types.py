"""What passes between stages is checked once, when it is made."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from laser_slam.types import Layers, Prediction, Trajectory, WindowStatus


def parts(num: int = 2) -> dict[str, Any]:
    return {
        "frames": np.arange(num),
        "depth": np.ones((num, 4, 6), np.float32),
        "confidence": np.ones((num, 4, 6), np.float32),
        "window_from_cam": np.tile(np.eye(4), (num, 1, 1)),
        "intrinsics": np.tile(np.eye(3), (num, 1, 1)),
    }


def test_a_sound_prediction_is_made_and_cannot_be_changed() -> None:
    prediction = Prediction(**parts())
    assert prediction.status is WindowStatus.OK
    with pytest.raises(dataclasses.FrozenInstanceError):
        prediction.status = WindowStatus.FAILED  # type: ignore[misc]


def test_unknown_depth_with_no_confidence_is_sound() -> None:
    unknown = parts()
    unknown["depth"][0, 1] = np.nan
    unknown["confidence"][0, 1] = 0
    Prediction(**unknown)
    nothing = parts()
    nothing["depth"][:], nothing["confidence"][:] = np.nan, 0
    Prediction(**nothing, status=WindowStatus.STATIC, warnings=("standstill",))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("depth", np.ones((3, 4, 6), np.float32), r"depth must be \(2, H, W\)"),
        ("depth", np.ones((2, 24), np.float32), r"depth must be \(2, H, W\)"),
        ("confidence", np.ones((2, 6, 4), np.float32), "confidence"),
        ("window_from_cam", np.eye(4), "poses must be"),
        ("intrinsics", np.eye(3), "intrinsics"),
        ("window_from_cam", np.full((2, 4, 4), np.nan), "finite"),
        ("intrinsics", np.full((2, 3, 3), np.inf), "finite"),
        ("depth", np.zeros((2, 4, 6), np.float32), "depth must be positive"),
        ("depth", np.full((2, 4, 6), np.nan, np.float32), "depth must be positive"),
        ("depth", np.full((2, 4, 6), np.inf, np.float32), "depth must be positive"),
        ("depth", -np.ones((2, 4, 6), np.float32), "depth must be positive"),
        ("confidence", np.full((2, 4, 6), np.nan, np.float32), "confidence must be"),
        ("confidence", np.full((2, 4, 6), 1.5, np.float32), "confidence must be"),
        ("confidence", np.full((2, 4, 6), -0.5, np.float32), "confidence must be"),
        ("frames", np.array([4, 3]), "rising"),
        ("frames", np.array([3, 3]), "rising"),
    ],
)
def test_an_unsound_prediction_is_refused(name: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Prediction(**{**parts(), name: value})


def test_a_trajectory_needs_as_many_times_as_poses() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    Trajectory(np.arange(3), np.arange(3) / 10, poses)
    with pytest.raises(ValueError, match="trajectory of 3 frames"):
        Trajectory(np.arange(3), np.arange(2) / 10, poses)
    with pytest.raises(ValueError, match="trajectory of 3 frames"):
        Trajectory(np.arange(3), np.arange(3) / 10, poses[:2])


def test_the_frames_of_a_trajectory_rise() -> None:
    with pytest.raises(ValueError, match="rising"):
        Trajectory(np.array([0, 2, 1]), np.arange(3) / 10, np.tile(np.eye(4), (3, 1, 1)))


def test_a_trajectory_is_finite() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        Trajectory(np.arange(3), np.arange(3) / 10, poses)


def layers_with(**changes: Any) -> Layers:
    """Two frames, with two layers and with one."""
    labels = np.zeros((2, 3, 4), np.uint16)
    labels[0, 0], labels[0, 1], labels[1, 2] = 1, 2, 1
    sound = {
        "labels": labels,
        "starts": np.array([0, 2, 3]),
        "scales": np.array([1.0, 0.9, 1.1]),
        "witnesses": np.ones(3),
        "curve": np.array([[1.0, 1.1], [2.0, 0.9]]),
    }
    return Layers(**{**sound, **changes})


def test_sound_layers_are_made_with_a_curve_or_without() -> None:
    assert len(layers_with().curve) == 2
    assert len(layers_with(curve=np.empty((0, 2))).curve) == 0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("labels", np.zeros((3, 4), np.uint16), "labels"),
        ("starts", np.array([0, 3]), "starts"),
        ("starts", np.array([0, 2, 4]), "3 scales"),
        ("starts", np.array([1, 2, 3]), "3 scales"),
        ("scales", np.array([1.0, 0.9]), "2 scales"),
        ("witnesses", np.ones(2), "3 scales"),
        ("curve", np.ones(4), "a curve must be"),
        ("curve", np.ones((2, 3)), "a curve must be"),
        ("scales", np.array([1.0, 0.0, 1.0]), "positive and finite"),
        ("scales", np.array([1.0, np.nan, 1.0]), "positive and finite"),
        ("scales", np.array([1.0, np.inf, 1.0]), "positive and finite"),
        ("curve", np.array([[1.0, -1.0]]), "positive and finite"),
    ],
)
def test_unsound_layers_are_refused(name: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        layers_with(**{name: value})
