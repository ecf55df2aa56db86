"""Tables score every frame that has truth, and of it what the published protocols compare."""

import math
import os
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.benchmarks.measures import MEASURES, look_up, remarks, weight, why_missing
from laser_slam.benchmarks.protocols import PROTOCOLS
from laser_slam.benchmarks.stretch import Stretch
from laser_slam.benchmarks.truth import (
    TruePoints,
    exact_points,
    resized_depth,
    room_points,
    seven_scenes_points,
    street_points,
)
from laser_slam.camera import intrinsics_matrix, rays, resize_intrinsics, unproject
from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.export import DepthView
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Frame, SequenceInfo, Trajectory

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

DATA = os.environ.get("LASER_SLAM_DATA")
SIZE = (48, 56)
NUM = 6
K = intrinsics_matrix(50.0, 50.0, 27.5, 23.5)
ELSEWHERE = Sim3(0.2, rotation_exp(np.array([0.3, -1.0, 0.4])), np.array([4.0, -2.0, 9.0]))


def wall(frame: int) -> Depth:
    """Return the depth of a wavy wall along which the camera moves 0.5 m a frame."""
    x = rays(K, *SIZE)[..., 0] * 4 + 0.5 * frame
    return (4 + 0.5 * np.sin(1.3 * x) + 0.01 * np.arange(SIZE[0])[:, None]).astype(np.float32)


def world_from_cam(frame: int) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = 0.5 * frame, 0.02 * frame**2, 0.1 * frame
    return pose


class Wall:
    """The wall as a data set; its truth can be changed."""

    def __init__(self) -> None:
        self.truth = {frame: wall(frame) for frame in range(NUM)}

    @property
    def info(self) -> SequenceInfo:
        poses = np.array([world_from_cam(frame) for frame in range(NUM)])
        truth = Trajectory(np.arange(NUM), np.arange(NUM) / 10, poses)
        return SequenceInfo("wall", SIZE, NUM, K, "exact", truth)

    def frames(self) -> Generator[Frame, None, None]:
        raise NotImplementedError

    def true_depth(self, frame: int) -> Depth | None:
        return self.truth.get(frame)


def perfect_view(frame: int) -> DepthView:
    """See the wall as it is, in another frame and unit."""
    pose = ELSEWHERE.apply_poses(world_from_cam(frame)[None])[0]
    depth = wall(frame) * np.float32(ELSEWHERE.scale)
    colors = np.zeros((*SIZE, 3), np.uint8)
    return DepthView(frame, frame / 10, depth, np.ones(SIZE, np.float32), colors, K, pose)


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> dict[int, DepthView]:
    """What a run has of the wall; a test takes away or changes."""
    found = {frame: perfect_view(frame) for frame in range(NUM)}
    monkeypatch.setattr(
        "laser_slam.benchmarks.protocols._views", lambda _: iter(list(found.values()))
    )
    return found


def spoil(view: DepthView, pixels: NDArray[np.bool_], factor: float = 3.0) -> DepthView:
    return replace(view, depth=np.where(pixels, factor * view.depth, view.depth))


@pytest.mark.parametrize("protocol", ["points_indoor", "points_outdoor"])
def test_a_perfect_run_has_no_error(
    protocol: str, views: dict[int, DepthView], tmp_path: Path
) -> None:
    errors = PROTOCOLS[protocol](tmp_path, Wall())
    assert errors["chamfer_m"] == pytest.approx(0, abs=1e-5)
    assert errors["scale"] == pytest.approx(1 / ELSEWHERE.scale)
    assert errors["coverage"] == 1
    assert errors["num_frames"] == errors["num_predicted"] == NUM


def test_truth_beyond_ten_metres_is_not_in_the_table_of_rooms(
    views: dict[int, DepthView], tmp_path: Path
) -> None:
    """A window shows what is far away: the prediction is wrong there, and nobody asks."""
    dataset = Wall()
    window = np.zeros(SIZE, np.bool_)
    window[15:30, 20:40] = True
    for frame in range(NUM):
        dataset.truth[frame] = np.where(window, np.float32(30.0), wall(frame))
        views[frame] = spoil(views[frame], window)
    errors = PROTOCOLS["points_indoor"](tmp_path, dataset)
    assert errors["chamfer_m"] == pytest.approx(0, abs=1e-5)
    assert errors["coverage"] == 1


def test_the_deepest_laser_points_are_not_in_the_table_of_streets(
    views: dict[int, DepthView], tmp_path: Path
) -> None:
    """A laser sees every eighth column; a tenth of its points, 1.25 % of the pixels, is wrong."""
    dataset = Wall()
    seen = np.zeros(SIZE, np.bool_)
    seen[:, ::8] = True
    strays = np.zeros(SIZE, np.bool_)
    strays[:5, ::8] = True
    for frame in range(NUM):
        truth = np.where(strays, np.float32(70.0), wall(frame))
        dataset.truth[frame] = np.where(seen, truth, np.float32(np.nan))
    errors = PROTOCOLS["points_outdoor"](tmp_path, dataset)
    assert errors["chamfer_m"] == pytest.approx(0, abs=1e-5)
    assert errors["num_truth"] < NUM * (seen & ~strays).sum()


@pytest.mark.parametrize("protocol", ["points_indoor", "points_outdoor"])
def test_truth_of_frames_that_the_run_lost_counts_as_not_predicted(
    protocol: str, views: dict[int, DepthView], tmp_path: Path
) -> None:
    for frame in range(NUM // 2, NUM):
        del views[frame]
    errors = PROTOCOLS[protocol](tmp_path, Wall())
    assert errors["acc_mean_m"] == pytest.approx(0, abs=1e-5)
    assert errors["comp_mean_m"] > 0.1
    assert errors["coverage"] == pytest.approx(0.5)
    assert (errors["num_predicted"], errors["num_frames"]) == (NUM // 2, NUM)


def test_a_lost_beginning_counts_as_a_lost_end_does(
    views: dict[int, DepthView], tmp_path: Path
) -> None:
    for frame in range(NUM // 2):
        del views[frame]
    for protocol in ("points_indoor", "video_depth_kitti"):
        errors = PROTOCOLS[protocol](tmp_path, Wall())
        assert errors["coverage"] == pytest.approx(0.5)
        assert errors["num_predicted"] == NUM // 2


def test_frames_without_depth_count_in_a_videos_coverage(
    views: dict[int, DepthView], tmp_path: Path
) -> None:
    del views[2]
    views[4] = replace(views[4], depth=np.full(SIZE, np.nan, np.float32))
    errors = PROTOCOLS["video_depth_bonn"](tmp_path, Wall())
    assert errors["abs_rel"] == pytest.approx(0, abs=1e-6)
    assert errors["coverage"] == pytest.approx((NUM - 2) / NUM)
    assert (errors["num_predicted"], errors["num_frames"]) == (NUM - 2, NUM)
    assert errors["num_true_pixels"] == NUM * SIZE[0] * SIZE[1]


@pytest.mark.parametrize("protocol", sorted(PROTOCOLS))
def test_a_run_without_depth_says_so(
    protocol: str, views: dict[int, DepthView], tmp_path: Path
) -> None:
    views.clear()
    errors = PROTOCOLS[protocol](tmp_path, Wall())
    assert errors["reason"] in {"the run has no depth map", "no pixel has both depth and truth"}


# --- the truth of published tables ---------------------------------------------------------------


def focal_and_centre(points: Array) -> Array:
    """Find the camera of (H, W, 3) points: fx, fy, cx, cy."""
    height, width = points.shape[:2]
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    fx, cx = np.polyfit(x[0], np.arange(width), 1)
    fy, cy = np.polyfit(y[:, 0], np.arange(height), 1)
    return np.array([fx, fy, cx, cy])


@pytest.mark.parametrize(
    ("focal_px", "points"), [(525.0, seven_scenes_points), (554.2562584220408, room_points)]
)
def test_published_truth_of_rooms_has_the_camera_of_its_evaluation(
    focal_px: float, points: TruePoints
) -> None:
    """Both data sets with NRGBD's focal length, both axes with the larger factor 392 / 480."""
    factor = 392 / 480
    true = intrinsics_matrix(focal_px, focal_px, 320.0, 240.0)
    depth = np.full((480, 640), 2.0, np.float32)
    focal, centre = 554.2562584220408 * factor, np.array([320.5, 240.5]) * factor - 0.5
    found = focal_and_centre(points(depth, true, (392, 518)))
    np.testing.assert_allclose(found, [focal, focal, *centre], rtol=1e-6)
    half = focal_and_centre(points(depth, true, (196, 259)))
    np.testing.assert_allclose(half, [focal / 2, focal / 2, *((centre - 0.5) / 2)], rtol=1e-6)
    exact = focal_and_centre(exact_points(depth, true, (392, 518)))
    wide, high = 518 / 640, factor
    expected = [focal_px * wide, focal_px * high, 320.5 * wide - 0.5, 240.5 * high - 0.5]
    np.testing.assert_allclose(exact, expected, rtol=1e-6)


def cropped_and_resized(values: Depth, intrinsics: Array, size: tuple[int, int]) -> Depth:
    """Crop around the principal point, enlarge and crop, step by step as is published; NaN: none.

    The first crop is as large as the image lets it be; the second one is padded.
    """
    height, width = values.shape
    cx, cy = intrinsics[0, 2], intrinsics[1, 2]
    half_w, half_h = math.floor(min(cx, width - cx)), math.floor(min(cy, height - cy))
    left, top = math.floor(cx) - half_w, math.floor(cy) - half_h
    values = values[top : top + 2 * half_h, left : left + 2 * half_w]
    factor = max((size[0] + 4) / values.shape[0], (size[1] + 4) / values.shape[1])
    new = math.floor(values.shape[1] * factor), math.floor(values.shape[0] * factor)
    larger = cv2.resize(values, new, interpolation=cv2.INTER_NEAREST)
    actual = max(larger.shape[0] / values.shape[0], larger.shape[1] / values.shape[1])
    cx, cy = (cx - left + 0.5) * actual - 0.5, (cy - top + 0.5) * actual - 0.5
    left = math.floor(cx) - math.floor(min(size[1] / 2, cx))
    top = math.floor(cy) - math.floor(min(size[0] / 2, cy))
    cropped = larger[top : top + size[0], left : left + size[1]]
    out = np.full(size, np.nan, np.float32)
    out[: cropped.shape[0], : cropped.shape[1]] = cropped
    return out


@pytest.mark.parametrize("centre", [(256.0, 170.5), (251.3, 176.8), (262.9, 161.2)])
def test_published_truth_of_streets_is_that_of_the_pixels_its_evaluation_takes(
    centre: tuple[float, float],
) -> None:
    camera = intrinsics_matrix(550.0, 550.0, *centre)
    depth = np.random.default_rng(0).uniform(5, 60, (341, 512)).astype(np.float32)
    found = street_points(depth, camera, (350, 518))
    for axis in range(3):
        there = unproject(depth, camera)[..., axis].astype(np.float32)
        expected = cropped_and_resized(there, camera, (350, 518))
        np.testing.assert_array_equal(found[..., axis].astype(np.float32), expected)


@pytest.mark.parametrize("name", ["7scenes", "nrgbd", "waymo"])
def test_a_perfect_map_has_errors_against_the_truth_of_published_tables(
    name: str, views: dict[int, DepthView], tmp_path: Path
) -> None:
    published = PROTOCOLS[f"points_{name}"](tmp_path, Wall())
    exact = PROTOCOLS["points_indoor"](tmp_path, Wall())
    assert published["chamfer_m"] > 100 * exact["chamfer_m"]
    assert abs(published["scale"] * ELSEWHERE.scale - 1) > 1e-3


@pytest.mark.skipif(DATA is None, reason="LASER_SLAM_DATA does not name the data folder")
def test_a_perfect_map_of_a_real_room_has_the_errors_that_the_page_on_metrics_tells(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Against the bent truth of 7-Scenes: millimetres, and normals that disagree.

    The more frames overlap, the less normals agree: here are two.
    """
    room = Stretch(SevenScenes(Path(str(DATA)) / "7scenes/kitchen/seq-01"), 0, 200, 100)
    info, size = room.info, (392, 518)
    assert info.truth is not None
    assert info.intrinsics is not None
    K = resize_intrinsics(info.intrinsics, info.size, size)
    views = []
    for frame, pose in enumerate(info.truth.world_from_cam):
        depth = room.true_depth(frame)
        assert depth is not None
        colors, sure = np.zeros((*size, 3), np.uint8), np.ones(size, np.float32)
        views.append(DepthView(frame, 0.0, resized_depth(depth, size), sure, colors, K, pose))
    monkeypatch.setattr("laser_slam.benchmarks.protocols._views", lambda _: iter(views))
    errors = PROTOCOLS["points_7scenes"](tmp_path, room)
    assert 0.002 < errors["acc_mean_m"] < 0.008
    assert errors["nc_mean"] < 0.96
    assert errors["scale"] == pytest.approx(0.988, abs=0.005)


def test_the_run_is_not_judged_with_its_own_intrinsics(
    views: dict[int, DepthView], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = Wall()
    unknown = replace(dataset.info, intrinsics=None)
    monkeypatch.setattr(Wall, "info", unknown)
    reason = PROTOCOLS["points_indoor"](tmp_path, dataset)["reason"]
    assert reason == "the intrinsics of the true depth are unknown"


# --- what a reader is told -----------------------------------------------------------------------


def test_what_a_run_has_no_numbers_of_is_told() -> None:
    scores = {
        "run": {"trajectory": {"num_frames": 40, "num_truth": 90}},
        "video_depth_bonn": {"num_predicted": 108, "num_frames": 110},
        "points_indoor": {"num_predicted": 10, "num_frames": 10},
    }
    assert remarks(scores) == (
        "50 of 90 frames with a true pose have none and are not scored",
        "video_depth_bonn: 2 of 110 frames have no depth",
    )
    whole = {"run": {"trajectory": {"num_frames": 90, "num_truth": 90}}}
    assert remarks(whole) == remarks({"run": {"trajectory": None}}) == remarks({}) == ()


@pytest.mark.parametrize("name", MEASURES)
def test_no_number_is_missing_without_a_reason(name: str) -> None:
    """Whatever a protocol leaves out, a reader is told something."""
    measure = MEASURES[name]
    for result in ({}, {measure.path: None}, {measure.path: float("nan")}, None):
        scores = {measure.protocol: result}
        assert look_up(scores, measure) is None
        assert why_missing(scores, measure)


def test_a_video_weighs_its_pixels_with_truth_whatever_a_run_predicts() -> None:
    measure = MEASURES["kitti_abs_rel"]
    little = {measure.protocol: {"num_pixels": 10, "num_true_pixels": 5000}}
    assert weight(little, measure) == 5000
    assert weight({"run": {"trajectory": {"num_truth": 90}}}, MEASURES["ate_m"]) == 1
    points = MEASURES["indoor_acc_m"]
    assert weight({points.protocol: {"num_truth": 90, "num_points": 80}}, points) == 1
