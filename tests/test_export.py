"""Files that other programs read back the same, and that appear whole or not at all."""

import resource
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from laser_slam.dependencies import import_open3d
from laser_slam.errors import RunFolderError
from laser_slam.export import write_kitti, write_ply, write_tum
from laser_slam.types import Cloud, Trajectory


def random_cloud(num: int, center: float = 0.0, voxel_size: float = 0.01) -> Cloud:
    rng = np.random.default_rng(num)
    return Cloud(
        points=center + rng.normal(size=(num, 3)),
        colors=rng.integers(0, 256, (num, 3), dtype=np.uint8),
        weights=rng.uniform(0.5, 9, num).astype(np.float32),
        voxel_size=voxel_size,
    )


def random_trajectory(num: int) -> Trajectory:
    rng = np.random.default_rng(num)
    world_from_cam = np.tile(np.eye(4), (num, 1, 1))
    world_from_cam[:, :3, :3] = Rotation.random(num, rng).as_matrix()
    world_from_cam[:, :3, 3] = 100 * rng.normal(size=(num, 3))
    return Trajectory(np.arange(num), 1317384506.4 + 0.1 * np.arange(num), world_from_cam)


def test_a_cloud_comes_back_from_its_ply_file(tmp_path: Path) -> None:
    cloud = random_cloud(1000)
    write_ply(tmp_path / "map.ply", cloud)
    back = import_open3d().t.io.read_point_cloud(str(tmp_path / "map.ply")).point
    np.testing.assert_allclose(back["positions"].numpy(), cloud.points, atol=1e-6)
    np.testing.assert_array_equal(back["colors"].numpy(), cloud.colors)
    np.testing.assert_array_equal(back["weight"].numpy()[:, 0], cloud.weights)
    assert back["positions"].numpy().dtype == np.float32
    assert b"binary" in (tmp_path / "map.ply").read_bytes()[:60]


def test_points_far_from_the_origin_lose_nothing(tmp_path: Path) -> None:
    cloud = random_cloud(100, center=4.5e6, voxel_size=0.05)
    write_ply(tmp_path / "map.ply", cloud)
    back = import_open3d().io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_allclose(np.asarray(back.points), cloud.points, rtol=0, atol=1e-8)


def test_an_empty_cloud_is_a_valid_file(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", random_cloud(0))
    header = (tmp_path / "map.ply").read_text().splitlines()
    assert header[0] == "ply"
    assert "element vertex 0" in header
    assert header[-1] == "end_header"
    assert len(import_open3d().io.read_point_cloud(str(tmp_path / "map.ply")).points) == 0


def test_evo_reads_the_kitti_file(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo not installed")
    trajectory = random_trajectory(20)
    write_kitti(tmp_path / "poses.txt", trajectory)
    back = file_interface.read_kitti_poses_file(tmp_path / "poses.txt")
    np.testing.assert_allclose(back.poses_se3, trajectory.world_from_cam, rtol=1e-9, atol=1e-9)


def test_evo_reads_the_tum_file(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo not installed")
    trajectory = random_trajectory(20)
    write_tum(tmp_path / "poses.txt", trajectory)
    back = file_interface.read_tum_trajectory_file(tmp_path / "poses.txt")
    np.testing.assert_allclose(back.timestamps, trajectory.times_s, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.poses_se3, trajectory.world_from_cam, rtol=1e-8, atol=1e-8)


def test_a_trajectory_without_frames_is_an_empty_file(tmp_path: Path) -> None:
    empty = Trajectory(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 4, 4)))
    write_tum(tmp_path / "tum.txt", empty)
    write_kitti(tmp_path / "kitti.txt", empty)
    assert (tmp_path / "tum.txt").read_text() == (tmp_path / "kitti.txt").read_text() == ""


@pytest.mark.parametrize("name", ["map.ply", "kitti.txt", "tum.txt"])
def test_a_missing_folder_is_an_error_that_says_what_to_do(tmp_path: Path, name: str) -> None:
    with pytest.raises(RunFolderError, match=rf"{name}: No such file or directory; create"):
        write(tmp_path / "nowhere" / name)


@pytest.mark.parametrize("name", ["map.ply", "kitti.txt", "tum.txt"])
def test_no_space_leaves_the_old_file_and_nothing_else(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
    try:
        with pytest.raises(RunFolderError, match=r"cannot write .*; .*choose another folder"):
            write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def write(path: Path) -> None:
    if path.name == "map.ply":
        write_ply(path, random_cloud(20_000))
    elif path.name == "kitti.txt":
        write_kitti(path, random_trajectory(1000))
    else:
        write_tum(path, random_trajectory(1000))
