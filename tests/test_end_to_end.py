"""The commands that people type, on a generated and on a real drive; every error in a band."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from laser_slam.cli import app
from laser_slam.dependencies import import_open3d

DATA = os.environ.get("LASER_SLAM_DATA")


def run(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run a command and return its report."""
    result = CliRunner().invoke(app, [*arguments, "--out", str(folder), "--quiet"])
    assert result.exit_code == 0, result.output
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return report


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Map a short generated drive with the default backbone, reduced in size alone."""
    folder = tmp_path_factory.mktemp("runs") / "demo"
    settings = ("synthetic.num_frames=45", "synthetic.width=416", "synthetic.height=128")
    return folder, run(folder, "demo", *(part for s in settings for part in ("--set", s)))


def test_the_demo_finds_its_path_within_half_a_percent(demo: tuple[Path, dict[str, Any]]) -> None:
    errors = demo[1]["trajectory"]
    assert 35 < errors["path_length_m"] < 45
    assert errors["ate_sim3_m"]["rmse"] < 0.005 * errors["path_length_m"]
    assert errors["rpe_rotation_deg"]["rmse"] < 0.1


def test_the_demo_knows_its_depth_where_it_says_so(demo: tuple[Path, dict[str, Any]]) -> None:
    depth = demo[1]["depth"]["by_trajectory_scale"]
    assert depth["abs_rel"] < 0.05
    assert depth["coverage"] > 0.4


def test_the_demo_bridges_nothing_and_gives_every_frame_a_pose(
    demo: tuple[Path, dict[str, Any]],
) -> None:
    folder, report = demo
    assert report["windows"]["bridged"] == {}
    assert np.loadtxt(folder / "trajectory_kitti.txt").shape == (45, 12)
    assert np.loadtxt(folder / "trajectory_tum.txt").shape == (45, 8)


def test_the_map_of_the_demo_is_a_coloured_cloud_of_the_street(
    demo: tuple[Path, dict[str, Any]],
) -> None:
    cloud = import_open3d().io.read_point_cloud(str(demo[0] / "map.ply"))
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    assert len(points) == demo[1]["map"]["num_points"] > 50_000
    assert np.isfinite(points).all()
    assert colors.std(axis=0).min() > 0.05


@pytest.mark.skipif(DATA is None, reason="needs LASER_SLAM_DATA: real sequences")
def test_real_pixels_of_kitti_06_give_the_path_within_a_tenth_of_a_percent(tmp_path: Path) -> None:
    root = Path(str(DATA)) / "kitti_odometry"
    report = run(tmp_path / "run", "kitti", "06", "--root", str(root),
                 "--set", "backbone.classical.depth_width=320")  # fmt: skip
    errors = report["trajectory"]
    assert errors["ate_sim3_m"]["rmse"] < 0.001 * errors["path_length_m"]
    assert report["windows"]["bridged"] == {}
    assert report["frames"] == {"read": 51, "unreadable": 0, "keyframes": 51}
