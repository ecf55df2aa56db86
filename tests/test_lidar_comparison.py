"""Runs judged by laser scans of the corridor, where every distance is known."""

import json
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corridor import (
    DISTANCES,
    NORMALS,
    SIZE,
    Corridor,
    TrueBackbone,
    true_intrinsics,
    true_pose,
    view,
)
from image_files import write_png
from numpy.typing import NDArray
from quick_runs import leave_pictures_out
from scans import beams, cam0_from_velo, write_scan
from typer.testing import CliRunner

from laser_slam.backbones import BACKBONES
from laser_slam.cli import app
from laser_slam.config import load_config
from laser_slam.datasets.velodyne import Rig, Velodyne
from laser_slam.errors import DegenerateGeometryError
from laser_slam.evaluation.clouds import ScanDistances, cloud_errors
from laser_slam.lidar import compare_with_run
from laser_slam.lidar.alignment import align_cameras, align_pieces, stretch_scales
from laser_slam.pipeline import Pipeline
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Prediction, Trajectory

NUM = 24
SCANNED = tuple(range(0, NUM, 3))
ROUNDING = 0.02  # of depth: half a pixel of 128, on walls that are seen at a grazing angle
CONFIG = load_config(
    assignments=["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"]
)


class FarSighted(TrueBackbone):
    """A backbone that sees everything a tenth too far, and moves rightly."""

    def predict(self, *arguments: Any) -> Prediction:
        right = super().predict(*arguments)
        return replace(right, depth=right.depth * np.float32(1.1))


def true_backbone(config: object) -> TrueBackbone:
    return TrueBackbone()


def scan(frame: int) -> NDArray[np.float64]:
    """Return what the scanner sees of the corridor's planes."""
    directions = beams()[::7]
    world_from_velo = true_pose(frame) @ cam0_from_velo()
    gap = DISTANCES - NORMALS @ world_from_velo[:3, 3]
    with np.errstate(divide="ignore"):
        far = gap / (directions @ world_from_velo[:3, :3].T @ NORMALS.T)
    nearest = np.where(far > 0, far, np.inf).min(axis=1)
    seen = nearest < 80  # the corridor is open behind
    return np.asarray(directions[seen] * nearest[seen, None])


@pytest.fixture(scope="module")
def velodyne(tmp_path_factory: pytest.TempPathFactory) -> Velodyne:
    folder = tmp_path_factory.mktemp("scans")
    paths = {frame: folder / f"{frame:06d}.bin" for frame in SCANNED}
    for frame, path in paths.items():
        write_scan(path, scan(frame))
    rig = Rig(cam0_from_velo(), true_intrinsics(), SIZE)
    return Velodyne(paths, np.arange(NUM) / 10.0, rig, is_compensated=True)


def true_path(frames: Iterable[int] = SCANNED) -> Trajectory:
    rows = np.array(list(frames), np.int64)
    return Trajectory(rows, rows / 10.0, np.stack([true_pose(int(f)) for f in rows]))


def judge(folder: Path, backbone: TrueBackbone, velodyne: Velodyne) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        leave_pictures_out(patch)
        Pipeline(Corridor(NUM, with_truth=False), CONFIG, folder, backbone=backbone).run()
    out = folder.with_name(f"{folder.name}-lidar")
    out.mkdir()
    return compare_with_run(folder, true_path(), velodyne, out)


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory, velodyne: Velodyne) -> dict[str, Any]:
    return judge(tmp_path_factory.mktemp("runs") / "right", TrueBackbone(), velodyne)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory, velodyne: Velodyne) -> dict[str, Any]:
    return judge(tmp_path_factory.mktemp("runs") / "wrong", FarSighted(), velodyne)


def test_a_right_run_lies_on_its_scans(right: dict[str, Any]) -> None:
    assert right["depth"]["by_trajectory_scale"]["abs_rel"] < ROUNDING
    assert right["depth"]["num_keyframes"] >= 4
    assert right["trajectory"]["ate_sim3_m"]["rmse"] < 0.02
    cloud = right["cloud"]
    assert cloud["num_scans"] == len(SCANNED)
    assert cloud["num_points"] > 500
    assert cloud["median_m"] < 0.1
    assert cloud["within_50_cm"] > 0.95


def test_the_metric_scale_is_the_same_by_path_and_by_depth(right: dict[str, Any]) -> None:
    scale = right["scale"]
    unit_m = scale["metres_per_world_unit"]
    assert 0.5 < unit_m < 8  # what the backbone's first window draws
    for spread in (scale["by_stretches"], scale["by_depth_of_keyframes"]):
        assert spread["p16"] <= spread["median"] <= spread["p84"]
        assert abs(spread["median"] / unit_m - 1) < 0.01


def test_depth_a_tenth_too_far_shows_in_depth_cloud_and_scale(
    right: dict[str, Any], wrong: dict[str, Any]
) -> None:
    scores = wrong["depth"]
    assert 0.09 < scores["by_trajectory_scale"]["abs_rel"] < 0.11
    assert 0.09 < scores["median_rel"] < 0.11
    assert all(0.08 < band["median_rel"] < 0.12 for band in scores["by_range"])
    num_pixels = sum(band["num_pixels"] for band in scores["by_range"])
    assert num_pixels == scores["by_median_ratio"]["num_pixels"]
    assert scores["by_median_ratio"]["abs_rel"] < ROUNDING
    scale = wrong["scale"]
    ratio = scale["by_depth_of_keyframes"]["median"] / scale["metres_per_world_unit"]
    assert abs(ratio * 1.1 - 1) < 0.01
    assert wrong["cloud"]["median_m"] > 2 * right["cloud"]["median_m"]


def test_the_kitti_command_scores_depth_by_the_scans_beside_the_images(
    velodyne: Velodyne, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "sequences/00"
    for frame in range(NUM):
        write_png(folder / f"image_2/{frame:06d}.png", view(frame)[0])
    shutil.copytree(velodyne.paths[0].parent, folder / "velodyne")
    rows = {"P2": np.c_[true_intrinsics(), np.zeros(3)], "Tr": cam0_from_velo()[:3]}
    text = [f"{name}: {' '.join(map(str, row.ravel()))}\n" for name, row in rows.items()]
    (folder / "calib.txt").write_text("".join(text))
    (folder / "times.txt").write_text("".join(f"{0.1 * frame}\n" for frame in range(NUM)))
    leave_pictures_out(monkeypatch)
    monkeypatch.setitem(BACKBONES, "classical", f"{__name__}:true_backbone")
    settings = ("windows.size=8", "windows.min_parallax_px=0.2", f"run.samples={NUM}")
    command = ["kitti", "0", "--root", str(tmp_path), "--out", str(tmp_path / "run"), "--quiet"]
    for setting in settings:
        command += ["--set", setting]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "depth AbsRel" in result.output
    report = json.loads((tmp_path / "run/report.json").read_text())
    assert report["trajectory"] is None
    assert report["depth"]["num_keyframes"] >= 4
    scores = report["depth"]["by_median_ratio"]
    assert scores["abs_rel"] < ROUNDING
    assert scores["num_pixels"] > 500


def test_a_straight_path_does_not_leave_the_roll_open() -> None:
    truth = true_path()
    truth.world_from_cam[:, :2, 3] = 0
    lidar_from_world = Sim3(3.0, rotation_exp(np.array([0.3, -0.2, 2.0])), np.array([1.0, 2, 3]))
    poses = lidar_from_world.inverse().apply_poses(truth.world_from_cam)
    found = align_cameras(replace(truth, world_from_cam=poses), truth)
    np.testing.assert_allclose(found.matrix(), lidar_from_world.matrix(), atol=1e-9)
    scales = stretch_scales(replace(truth, world_from_cam=poses), truth)
    np.testing.assert_allclose(scales, 3.0)
    assert len(scales) == len(SCANNED) - 1


def drifted(truth: Trajectory, bend_rad: float) -> Trajectory:
    """Bend a path a little at each frame, as odometry does, and take it in other units."""
    motions = np.linalg.inv(truth.world_from_cam[:-1]) @ truth.world_from_cam[1:]
    motions[:, :3, :3] = motions[:, :3, :3] @ rotation_exp(np.array([0, bend_rad, 0]))
    motions[:, :3, 3] *= np.linspace(0.25, 0.5, len(motions))[:, None]
    poses = [np.eye(4)]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    return replace(truth, world_from_cam=np.stack(poses))


def test_pieces_of_a_path_that_drifts_lie_on_the_truth() -> None:
    truth = true_path(range(0, 1000, 2))  # 400 m
    path = drifted(truth, 0.002)
    pieces, whole = align_pieces(path, truth), align_cameras(path, truth)
    assert len(pieces.lidar_from_world) == 8
    centers, true = path.world_from_cam[:, :3, 3], truth.world_from_cam[:, :3, 3]
    assert np.linalg.norm(whole.apply(centers) - true, axis=1).max() > 20
    assert np.linalg.norm(pieces.apply(centers) - true, axis=1).max() < 1.5
    scales = np.array([pieces.at(int(frame)).scale for frame in truth.frames])
    np.testing.assert_allclose(1 / scales, np.linspace(0.25, 0.5, len(scales)), rtol=0.08)


def test_a_piece_in_which_the_run_is_lost_goes_with_the_whole_path() -> None:
    truth = true_path(range(0, 300, 2))  # 120 m
    poses = truth.world_from_cam.copy()
    poses[80:] = poses[79]
    lost = replace(truth, world_from_cam=poses)
    pieces = align_pieces(lost, truth)
    assert len(pieces.lidar_from_world) == 2
    assert pieces.at(298).scale == align_cameras(lost, truth).scale
    assert pieces.at(0).scale == pytest.approx(1)


def test_paths_without_motion_have_no_scale() -> None:
    path = true_path()
    still = replace(path, world_from_cam=np.tile(np.eye(4), (len(SCANNED), 1, 1)))
    with pytest.raises(DegenerateGeometryError, match=r"the scanner moved 0.00 m, need 1 m"):
        align_cameras(path, still)
    with pytest.raises(DegenerateGeometryError, match="the run's path stays in one place"):
        align_cameras(still, path)
    with pytest.raises(DegenerateGeometryError, match="1 frames in common, need 2"):
        align_cameras(true_path([3]), path)


def test_points_before_a_wall_are_as_far_from_it_as_they_are() -> None:
    wall = np.stack(np.meshgrid([10.0], np.arange(-5, 5, 0.05), np.arange(-3, 3, 0.05)), -1)
    scan = wall.reshape(-1, 3)
    for offset, shares in ((0.05, [1, 1, 1]), (0.15, [0, 1, 1]), (0.4, [0, 0, 1])):
        distances = ScanDistances(scan[::11] - [offset, 0, 0], np.eye(4)[None])
        distances.add(0, scan)
        errors = cloud_errors(distances.distances)
        assert errors.median_m is not None
        assert abs(errors.median_m - offset) < 0.02
        found = np.array([errors.within_10_cm, errors.within_20_cm, errors.within_50_cm])
        np.testing.assert_allclose(found, shares, atol=0.02)


def test_points_outside_the_field_of_every_scan_are_not_compared() -> None:
    scan = np.stack(np.meshgrid([10.0], np.arange(-5, 5, 0.1), np.arange(-2, 1, 0.1)), -1)
    roof, wall, beyond = np.array([10.0, 0, 6]), np.array([10.0, 0, 0]), np.array([300.0, 0, 0])
    distances = ScanDistances(np.stack([roof, wall, beyond]), np.eye(4)[None])
    assert cloud_errors(distances.distances).median_m is None
    distances.add(0, scan.reshape(-1, 3))
    errors = cloud_errors(distances.distances)
    assert errors.num_points == 1
    assert errors.coverage == pytest.approx(1 / 3)
    assert errors.median_m == pytest.approx(0, abs=1e-9)
