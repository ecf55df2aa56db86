"""A street of known depth is mapped, scanned and compared, by the commands that users type."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scans
from corridor import TrueBackbone
from numpy.typing import NDArray
from quick_runs import leave_pictures_out
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from laser_slam.backbones import BACKBONES
from laser_slam.cli import app
from laser_slam.dependencies import import_kiss_icp
from laser_slam.errors import DependencyError
from laser_slam.exporting.ply import read_ply
from laser_slam.sim3 import Sim3
from laser_slam.types import Prediction

try:
    import_kiss_icp()
except DependencyError:
    pytest.skip("pip install 'laser-slam[lidar]'", allow_module_level=True)

UNIT_M = 2.5  # of the world that the backbone's first window draws
FAR = 15.0  # metres; what lies beyond is seen a fifth too near by the second backbone
SETTINGS = ("windows.size=8", "windows.min_parallax_px=0.2", "layers.enabled=never")


true_depth = cache(scans.true_depth)


class StreetBackbone(TrueBackbone):
    """A backbone that knows the street, in units of its own."""

    def predict(self, images: Any, frames: NDArray[np.int64], intrinsics: Any) -> Prediction:
        depth = np.stack([self.see(true_depth(int(frame))) for frame in frames])
        depth[depth > 60] = np.nan
        poses = np.stack([scans.true_pose(int(f)) @ scans.cam0_from_cam() for f in frames])
        window_from_world = Sim3(scale=1 / UNIT_M) @ Sim3.from_matrix(poses[0]).inverse()
        return Prediction(
            frames,
            (depth / UNIT_M).astype(np.float32),
            np.where(np.isfinite(depth), np.float32(0.9), np.float32(0)),
            window_from_world.apply_poses(poses),
            np.tile(scans.INTRINSICS, (len(frames), 1, 1)),
        )

    def see(self, depth: NDArray[np.float64]) -> NDArray[np.float64]:
        return depth


class ShortSighted(StreetBackbone):
    """It sees what is far a fifth too near."""

    def see(self, depth: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(depth > FAR, 0.8 * depth, depth)


def street_backbone(config: object) -> StreetBackbone:
    return StreetBackbone()


def short_sighted(config: object) -> StreetBackbone:
    return ShortSighted()


def invoke(*command: object) -> str:
    result = CliRunner().invoke(app, [*map(str, command)])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    return scans.write_kitti(folder, scans.NUM, scans.surface_scan, scans.view)


def compare(root: Path, backbone: Callable[[object], StreetBackbone]) -> tuple[str, Path]:
    """Map the street, and compare with its scans; return what is said and the folder."""
    out = root / backbone.__name__
    with pytest.MonkeyPatch.context() as patch:
        leave_pictures_out(patch)
        patch.setitem(BACKBONES, "classical", f"{__name__}:{backbone.__name__}")
        settings = [part for setting in SETTINGS for part in ("--set", setting)]
        invoke("kitti", 0, "--root", root, "--out", out / "run", "--quiet", *settings)
        command = ("lidar", "kitti", 0, "--root", root, "--run", out / "run")
        return invoke(*command, "--out", out / "lidar", "--quiet"), out / "lidar"


@pytest.fixture(scope="module")
def right(root: Path) -> tuple[str, Path]:
    return compare(root, street_backbone)


def comparison(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "lidar.json").read_text())["comparison"]
    assert isinstance(found, dict)
    return found


def test_a_right_run_has_its_unit_path_depth_and_surfaces_confirmed(
    right: tuple[str, Path],
) -> None:
    found = comparison(right[1])
    scale = found["scale"]
    assert scale["metres_per_world_unit"] == pytest.approx(UNIT_M, rel=0.005)
    assert scale["by_stretches"]["median"] == pytest.approx(UNIT_M, rel=0.01)
    assert scale["by_depth_of_keyframes"]["median"] == pytest.approx(UNIT_M, rel=0.005)
    assert found["trajectory"]["ate_sim3_m"]["rmse"] < 0.02
    depth = found["depth"]
    for name in ("by_trajectory_scale", "by_piece_scale", "by_median_ratio", "by_keyframe_ratio"):
        assert depth[name]["abs_rel"] < 0.02, name
        assert depth[name]["coverage"] > 0.9
    assert depth["median_rel"] < 0.005
    cloud = found["cloud"]
    # Of 15 laser points a square metre the nearest is 13 cm away in the mean; the road has 3.
    assert cloud["median_m"] < 0.2
    assert cloud["within_50_cm"] > 0.9
    assert cloud["coverage"] > 0.5
    assert cloud["by_pieces"]["median_m"] == pytest.approx(cloud["median_m"], abs=1e-6)


def test_what_is_wrong_from_a_distance_on_is_wrong_from_there_in_the_scores(
    root: Path, right: tuple[str, Path]
) -> None:
    _, folder = compare(root, short_sighted)
    found = comparison(folder)
    assert found["scale"]["metres_per_world_unit"] == pytest.approx(UNIT_M, rel=0.005)
    near, middle, far = found["depth"]["by_range"][:3]
    assert (near["to_m"], middle["to_m"], far["from_m"]) == (10, 20, 20)
    assert near["abs_rel"] < 0.02
    assert 0.03 < middle["abs_rel"] < 0.17
    assert far["abs_rel"] == pytest.approx(0.2, abs=0.02)
    assert far["median_rel"] == pytest.approx(0.2, abs=0.005)
    shares = [far["num_pixels"], middle["num_pixels"], near["num_pixels"]]
    assert sum(shares) == found["depth"]["by_piece_scale"]["num_pixels"]
    before = comparison(right[1])["cloud"]
    assert found["cloud"]["within_50_cm"] < before["within_50_cm"] - 0.1


def test_the_summary_says_it_in_a_few_lines(right: tuple[str, Path]) -> None:
    text = right[0]
    assert f"scans         {scans.NUM} of {scans.NUM} frames, path of 6." in text
    assert "ATE of LiDAR  0.0" in text
    assert "metric scale  2.50" in text or "metric scale  2.49" in text
    assert "ATE of run    0.0" in text
    assert "by distance: 0.0" in text
    assert "map to scans  median 0." in text
    assert len(text.splitlines()) == 9


def test_the_clouds_lie_in_the_metric_world_and_colours_tell_distances(
    right: tuple[str, Path],
) -> None:
    folder = right[1]
    for name in ("map_to_scans.png", "trajectory.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    cloud, laser = (
        next(iter(read_ply(folder / name, 0.1))) for name in ("map_to_scans.ply", "scans.ply")
    )
    truth = np.linalg.inv(scans.true_pose(0) @ scans.cam0_from_cam())
    surface = scans.SURFACE @ truth[:3, :3].T + truth[:3, 3]
    gap, _ = cKDTree(surface).query(laser.points)
    assert np.quantile(gap, 0.99) < 0.05
    gap, _ = cKDTree(laser.points).query(cloud.points)
    is_green = (cloud.colors == [26, 150, 65]).all(axis=1)
    is_red = (cloud.colors == [215, 25, 28]).all(axis=1)
    assert gap[is_green].max() < 0.11
    assert gap[is_red].min() > 0.49
    assert 0.2 < is_green.mean() < 0.95


def test_the_transform_makes_the_run_metric(right: tuple[str, Path]) -> None:
    folder = right[1]
    matrix = np.loadtxt(folder / "metric_from_world.txt")
    run = np.loadtxt(folder.parent / "run/trajectory_tum.txt")[:, 1:4]
    lidar = np.loadtxt(folder / "trajectory_tum.txt")[:, 1:4]
    np.testing.assert_allclose(run @ matrix[:3, :3].T + matrix[:3, 3], lidar, atol=0.03)
    out = folder.parent / "metric.xyz"
    options = ("--out", out, "--georeference", folder / "metric_from_world.txt")
    invoke("export", folder.parent / "run", "--to", "xyz", *options)
    exported = np.loadtxt(out)[:, :3]
    is_below = np.abs(exported[:, :2] - [0, scans.GROUND_M]).max(axis=1) < 1.0
    assert np.median(exported[is_below, 1]) == pytest.approx(scans.GROUND_M, abs=0.05)


def test_a_run_over_other_images_is_refused(right: tuple[str, Path], tmp_path: Path) -> None:
    other = scans.write_kitti(tmp_path, 3, scans.surface_scan)
    short = scans.write_kitti(tmp_path / "short", 3, scans.surface_scan, scans.view)
    run = right[1].parent / "run"
    for folder, num in ((other, 3), (short, 3)):
        command = ["lidar", "kitti", "0", "--root", folder, "--run", run, "--out", tmp_path / "out"]
        result = CliRunner().invoke(app, [*map(str, command), "--quiet"])
        assert result.exit_code == 1, result.output
        said = f"is over other images (kitti-00, {scans.NUM} frames) than those beside the scans"
        assert said in result.output
        assert f"(kitti-00, {num} frames)" in result.output
        assert not (tmp_path / "out").exists()
