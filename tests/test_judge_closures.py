"""The tool that holds closures against the truth."""

import numpy as np
from judge_closures import Rule, revisits

from laser_slam.sim3 import rotation_exp

RULE = Rule(4.0, 30.0, 60.0)


def lap(num_laps: float, radius_m: float = 30.0, *, backwards: bool = False) -> np.ndarray:
    angles = np.arange(0, num_laps * 2 * np.pi, 1 / radius_m)
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, 0, 3] = radius_m * (1 - np.cos(angles))
    poses[:, 2, 3] = radius_m * np.sin(angles)
    for pose, angle in zip(poses, angles, strict=True):
        pose[:3, :3] = rotation_exp(np.array([0.0, angle + np.pi * backwards, 0.0]))
    return poses


def test_a_second_lap_is_one_stretch_from_its_start_to_the_end() -> None:
    poses = lap(1.5)
    (stretch,) = revisits(poses, RULE)
    start = 2 * np.pi * 30 - 4  # it comes near before it has come round
    assert abs(stretch[0] - start) < 3
    assert stretch[1] == len(poses) - 1


def test_one_lap_and_a_lap_that_is_driven_the_other_way_are_no_revisit() -> None:
    assert revisits(lap(0.9), RULE) == []
    both = np.concatenate([lap(0.9), lap(0.9, backwards=True)[::-1]])
    assert revisits(both, RULE) == []
