"""Tables score every frame that has truth, and of it what the published protocols compare."""

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.benchmarks.measures import MEASURES, look_up, remarks, weight, why_missing
from laser_slam.benchmarks.protocols import FOCAL_READ_AS, PROTOCOLS, published_camera
from laser_slam.camera import intrinsics_matrix, rays
from laser_slam.export import DepthView
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Frame, SequenceInfo, Trajectory

Array = NDArray[np.float64]
Depth = NDArray[np.float32]

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


@pytest.mark.parametrize(
    ("focal_px", "focal_as"), [(525.0, FOCAL_READ_AS), (554.2562584220408, 1.0)]
)
def test_published_truth_of_rooms_has_the_camera_of_its_evaluation(
    focal_px: float, focal_as: float
) -> None:
    """Both data sets with NRGBD's focal length, both axes with the larger factor 392 / 480."""
    factor = 392 / 480
    true = intrinsics_matrix(focal_px, focal_px, 320.0, 240.0)
    found = published_camera(true, (480, 640), (392, 518), focal_as)
    focal = 554.2562584220408 * factor
    expected = intrinsics_matrix(focal, focal, 320.5 * factor - 0.5, 240.5 * factor - 0.5)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    half = published_camera(true, (480, 640), (196, 259), focal_as)
    np.testing.assert_allclose(
        rays(half, 196, 259)[98, 129], rays(found, 392, 518)[196:198, 258:260].mean(axis=(0, 1))
    )


def test_a_perfect_map_has_errors_against_the_truth_of_published_tables(
    views: dict[int, DepthView], tmp_path: Path
) -> None:
    bent = PROTOCOLS["points_7scenes"](tmp_path, Wall())
    less = PROTOCOLS["points_nrgbd"](tmp_path, Wall())
    exact = PROTOCOLS["points_indoor"](tmp_path, Wall())
    assert bent["chamfer_m"] > less["chamfer_m"] > 100 * exact["chamfer_m"]


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
