"""The tool that holds a map against the true surfaces."""

import numpy as np
import pytest
from judge_map import Truth, judge

from laser_slam.dependencies import import_open3d
from laser_slam.types import Cloud


def road(half_m: float = 10.0) -> Truth:
    """Make a level square; a camera has seen all of it."""
    open3d = import_open3d()
    corners = half_m * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32)
    raycaster = open3d.t.geometry.RaycastingScene()
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    raycaster.add_triangles(open3d.core.Tensor(corners), open3d.core.Tensor(triangles))
    return Truth(raycaster, grid(half_m))


def grid(half_m: float, height_m: float = 0.0) -> np.ndarray:
    x, z = (half_m * np.mgrid[-1:1:200j, -1:1:200j]).reshape(2, -1)
    return np.stack([x, np.full_like(x, height_m), z], axis=1)


def cloud_of(points: np.ndarray, normal: tuple[float, ...] = (0, -1, 0)) -> Cloud:
    num = len(points)
    normals = np.tile(np.array(normal, np.float32), (num, 1))
    return Cloud(points, np.zeros((num, 3), np.uint8), np.ones(num, np.float32), 0.1, normals)


def test_a_layer_of_points_is_as_far_off_as_it_lies_above_the_road() -> None:
    tilted = (0.0, -np.cos(0.2), np.sin(0.2))
    scores = judge(cloud_of(grid(10.0, 0.04), tilted), road())
    assert scores["accuracy_cm"] == pytest.approx(4, abs=0.01)
    assert scores["chamfer_cm"] == pytest.approx(4, abs=0.01)
    assert scores["precision_%"] == scores["recall_%"] == scores["f_%"] == 100
    assert scores["normals_deg"] == pytest.approx(np.degrees(0.2), abs=0.01)


def test_half_a_road_is_accurate_but_not_complete() -> None:
    points = grid(10.0)
    scores = judge(cloud_of(points[points[:, 0] < 0]), road())
    assert scores["accuracy_cm"] == pytest.approx(0, abs=1e-3)
    assert scores["recall_%"] == pytest.approx(50, abs=1)
    assert scores["completeness_cm"] > 40  # cut at a metre


def test_a_veil_is_complete_but_not_accurate() -> None:
    scores = judge(cloud_of(np.concatenate([grid(10.0), grid(10.0, -5.0)])), road())
    assert scores["completeness_cm"] == pytest.approx(0, abs=1e-3)
    assert scores["precision_%"] == pytest.approx(50, abs=1)
    assert scores["accuracy_cm"] == pytest.approx(50, abs=1)
