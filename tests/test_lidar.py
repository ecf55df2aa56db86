"""Laser scans of a street whose every depth and motion is known."""

import json
import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import scans
from image_files import write_png
from typer.testing import CliRunner

import laser_slam.datasets.velodyne as velodyne_module
from laser_slam.camera import intrinsics_matrix
from laser_slam.cli import app
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.datasets.kitti_calibration import raw_rig
from laser_slam.datasets.kitti_dates import DAYS
from laser_slam.datasets.kitti_raw import KittiRaw
from laser_slam.datasets.velodyne import (
    Depth,
    Rig,
    Velodyne,
    project_scan,
    raise_beams,
    read_scan,
    turn_shares,
)
from laser_slam.dependencies import import_kiss_icp
from laser_slam.errors import DatasetError, DependencyError
from laser_slam.evaluation import evaluate_trajectory
from laser_slam.lidar import track_camera
from laser_slam.lidar_odometry import Turn, track_scans
from laser_slam.sim3 import Sim3, interpolate_sim3
from laser_slam.types import Trajectory

try:
    import_kiss_icp()
    WITHOUT_KISS_ICP = False
except DependencyError:
    WITHOUT_KISS_ICP = True
needs_kiss_icp = pytest.mark.skipif(WITHOUT_KISS_ICP, reason="pip install 'laser-slam[lidar]'")

FLAT = Rig(scans.cam0_from_velo(), scans.INTRINSICS, scans.SIZE)


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scans.write_kitti(tmp_path_factory.mktemp("kitti"))


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> KittiOdometry:
    return KittiOdometry(scans.write_kitti(tmp_path_factory.mktemp("street"), 3, scans.scan), "0")


def true_path(num: int, cam0_from_cam: scans.Array) -> Trajectory:
    frames = np.arange(num, dtype=np.int64)
    poses = np.stack([scans.true_pose(int(frame)) @ cam0_from_cam for frame in frames])
    return Trajectory(frames, np.arange(num) / 10.0, np.linalg.inv(poses[0]) @ poses)


def share_wrong(found: Depth, frame: int) -> float:
    """Return which share of the known depth is off by more than 15 %."""
    known = np.isfinite(found)
    return float(np.mean(np.abs(found[known] / scans.true_depth(frame)[known] - 1) > 0.15))


def test_the_depth_of_a_kitti_frame_comes_from_its_scan(street: KittiOdometry) -> None:
    for frame in (0, 2):
        found = street.true_depth(frame)
        assert found is not None
        known = np.isfinite(found)
        assert known.mean() > 0.1
        assert np.median(np.abs(found[known] / scans.true_depth(frame)[known] - 1)) < 0.005
        assert share_wrong(found, frame) < 0.01


def test_what_only_the_scanner_sees_is_left_out(
    street: KittiOdometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera stands half a metre aside, so that boxes hide from it what the scanner sees."""
    velodyne = street.velodyne()
    cleaned = velodyne.depth(0)
    for name in ("_is_hidden", "_is_behind_outline"):
        monkeypatch.setattr(velodyne_module, name, lambda depth, *_: np.zeros(depth.shape, bool))
    raw = velodyne.depth(0)
    assert cleaned is not None
    assert raw is not None
    assert share_wrong(raw, 0) > 0.012
    assert share_wrong(cleaned, 0) < share_wrong(raw, 0) / 2.5
    assert np.isfinite(cleaned).sum() > 0.93 * np.isfinite(raw).sum()


def test_a_road_at_a_grazing_angle_hides_nothing_of_itself() -> None:
    directions = scans.beams()
    down = directions[directions[:, 2] < -0.02]
    road = down * (2.0 / -down[:, 2:])
    depth = project_scan(road, FLAT)
    inside = project_scan(road[np.linalg.norm(road, axis=1) < 1000], FLAT)
    assert np.isfinite(depth).sum() == np.isfinite(inside).sum() > 500
    assert np.nanmax(depth) > 60


def test_what_is_seen_over_a_shiny_roof_is_left_out() -> None:
    """The scanner, 8 cm above the camera, looks over a car whose upper edge sends nothing back."""
    intrinsics = intrinsics_matrix(720.0, 720.0, 200.0, 60.0)
    above = np.eye(4)
    above[1, 3] = -0.08
    rig = Rig(above, intrinsics, (200, 401))
    step = np.arange(-1.0, 1.0, 0.01)
    car = np.stack(np.meshgrid(step, np.arange(0.26, 1.0, 0.02), [4.0]), -1).reshape(-1, 3)
    wall = np.stack(np.meshgrid(10 * step, np.arange(-3.0, 4.0, 0.04), [35.0]), -1).reshape(-1, 3)
    at_car = wall[:, 1] * 4 / 35 - 0.08 * 31 / 35  # of the laser's way to the wall
    seen = np.concatenate([car, wall[at_car < 0.2]]) - above[:3, 3]
    both, alone = (project_scan(part, rig)[:, 30:370] for part in (seen, seen[len(car) :]))
    roof = 60 + 720 * 0.2 / 4
    assert np.nonzero(alone > 30)[0].max() > roof + 10
    assert np.nonzero(both > 30)[0].max() < roof + 1
    lost = np.nonzero((alone > 30) & ~(both > 30))[0]
    assert len(lost) > 1000
    assert lost.min() >= roof - 1
    assert (both < 5).sum() > 3000


def test_of_two_points_in_a_pixel_the_nearer_one_wins() -> None:
    rig = Rig(np.eye(4), scans.INTRINSICS, scans.SIZE)  # a scanner with the camera's axes
    points = np.array([[0.0, 0.0, 9.0], [0.0, 0.0, 4.0], [0.0, 0.0, 6.0], [0.0, 0.0, -4.0]])
    depth = project_scan(points, rig)
    assert np.isfinite(depth).sum() == 1
    assert depth[55, 200] == 4.0


def test_depth_maps_are_preferred_to_scans(tmp_path: Path) -> None:
    root = scans.write_kitti(tmp_path, 3)
    stored = np.full(scans.SIZE, 5 * 256, np.uint16)
    write_png(root / "sequences/00/depth/000001.png", stored)
    depth = KittiOdometry(root, "0").true_depth(1)
    assert depth is not None
    assert (depth == 5).all()


def test_scans_without_calibration_give_no_depth_but_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = scans.write_kitti(tmp_path, 3)
    calibration = root / "sequences/00/calib.txt"
    calibration.write_text(calibration.read_text().splitlines()[0] + "\n")
    assert KittiOdometry(root, "0").true_depth(0) is None
    assert "no depth from LiDAR" in caplog.text
    assert "has no row Tr" in caplog.text


@needs_kiss_icp
def test_the_path_of_the_camera_is_found_by_its_scans(kitti: Path, tmp_path: Path) -> None:
    out = tmp_path / "lidar"
    result = CliRunner().invoke(
        app, ["lidar", "kitti", "0", "--root", str(kitti), "--out", str(out), "--quiet"]
    )
    assert result.exit_code == 0, result.output
    assert f"{scans.NUM} of {scans.NUM} frames, path of 6." in result.output
    report = json.loads((out / "lidar.json").read_text())
    truth = true_path(scans.NUM, scans.cam0_from_cam())
    length_m = np.linalg.norm(np.diff(truth.world_from_cam[:, :3, 3], axis=0), axis=1).sum()
    assert abs(report["path_length_m"] / length_m - 1) < 0.02
    errors = report["errors"]
    assert errors["ate_se3_m"]["rmse"] < 0.05
    assert abs(errors["scale"] - 1) < 0.01
    rows = np.loadtxt(out / "trajectory_kitti.txt").reshape(-1, 3, 4)
    assert np.abs(rows[:, :, 3] - truth.world_from_cam[:, :3, 3]).max() < 0.06
    times = np.loadtxt(out / "trajectory_tum.txt")[:, 0]
    np.testing.assert_allclose(times, truth.times_s)


@needs_kiss_icp
def test_the_path_is_that_of_kiss_icps_own_pipeline_and_reader(
    kitti: Path,
) -> None:
    reader = import_module("kiss_icp.datasets.kitti").KITTIOdometryDataset(str(kitti), "00")
    pipeline = import_module("kiss_icp.pipeline").OdometryPipeline(reader)
    pipeline._run_pipeline()
    velodyne = KittiOdometry(kitti, "0").velodyne()
    ours = list(track_scans(Turn(f, raise_beams(velodyne.points(f))) for f in velodyne.paths))
    np.testing.assert_allclose(np.stack(ours), pipeline.poses, atol=1e-5)


@needs_kiss_icp
def test_the_path_of_a_raw_drive_is_kiss_icps_half_a_turn_before(tmp_path: Path) -> None:
    """KISS-ICP's poses hold at the end of a turn, ours in its middle."""

    def take(frame: int) -> scans.Array:
        return scans.landmarks(frame, turns_while_driving=True)

    velodyne = KittiRaw(scans.write_raw(tmp_path / "drive", 12, take)).velodyne()
    raised = [raise_beams(velodyne.points(frame)) for frame in velodyne.paths]
    times = import_module("kiss_icp.datasets.kitti_raw").KITTIRawDataset.get_timestamps
    kiss_icp = import_kiss_icp()
    odometry = kiss_icp.kiss_icp.KissICP(kiss_icp.config.load_config(None))
    theirs = []
    for points in raised:
        np.testing.assert_allclose(turn_shares(points), times(points), atol=1e-12)
        before = odometry.last_delta
        odometry.register_frame(points, times(points))
        half = interpolate_sim3(Sim3(), Sim3.from_matrix(before), np.array([-0.5]))[0]
        theirs.append(odometry.last_pose @ half.matrix())
    turns = (Turn(frame, points, turn_shares(points)) for frame, points in enumerate(raised))
    ours = list(track_scans(turns))
    gap_m = np.linalg.norm((np.stack(ours) - np.stack(theirs))[:, :3, 3], axis=1)
    assert gap_m.max() < 0.03  # the scanner moves 1 m a turn; KISS-ICP takes the first for halves
    assert gap_m[-1] < 0.01


@needs_kiss_icp
def test_beams_are_raised_as_kiss_icp_raises_them() -> None:
    pybind = import_module("kiss_icp.pybind").kiss_icp_pybind
    points = scans.scan(2)
    theirs = pybind._correct_kitti_scan(pybind._Vector3dVector(points))
    np.testing.assert_allclose(raise_beams(points), np.asarray(theirs), atol=1e-9)


def test_the_scanner_turns_clockwise_from_behind() -> None:
    around = np.array([[-1.0, 1e-9, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, -1e-9, 0]])
    np.testing.assert_allclose(turn_shares(around), [0, 0.25, 0.5, 0.75, 1], atol=1e-6)


@needs_kiss_icp
@pytest.mark.parametrize("missing", [(), (4, 7, 8), (1, 3, 5, 7, 9)], ids=["none", "some", "half"])
def test_scans_that_turned_while_the_car_drove_are_straightened(
    tmp_path: Path, missing: tuple[int, ...]
) -> None:
    """What is seen at the begin and the end of a turn lies up to a metre apart."""

    def take(frame: int) -> scans.Array:
        return scans.landmarks(frame, turns_while_driving=True)

    drive = scans.write_raw(tmp_path / "drive", 12, take)
    for frame in missing:  # as in drives of KITTI's
        (drive / f"velodyne_points/data/{frame:010d}.bin").unlink()
    velodyne = KittiRaw(drive).velodyne()
    as_they_are = Velodyne(velodyne.paths, velodyne.times_s, velodyne.rig, is_compensated=True)
    truth = true_path(12, scans.cam0_from_cam())
    straight, bent = (
        evaluate_trajectory(track_camera(one), truth).ate_se3_m for one in (velodyne, as_they_are)
    )
    assert straight is not None
    assert bent is not None
    assert straight.rmse < 0.008
    assert bent.rmse > 0.01


def test_a_raw_drive_is_read_with_times_calibration_and_depth(tmp_path: Path) -> None:
    drive = scans.write_raw(tmp_path / "2011_09_26_drive_0001_sync", 4, scans.scan)
    dataset = KittiRaw(drive)
    info = dataset.info
    assert (info.name, info.size) == ("kitti-raw-2011_09_26_drive_0001_sync", scans.SIZE)
    assert info.intrinsics is not None
    np.testing.assert_allclose(info.intrinsics, scans.INTRINSICS)
    np.testing.assert_allclose([f.time_s for f in dataset.frames()], [0, 0.1, 0.2, 0.3], atol=1e-8)
    rig = dataset.velodyne().rig
    expected = np.linalg.inv(scans.cam0_from_cam()) @ scans.cam0_from_velo()
    np.testing.assert_allclose(rig.cam_from_velo, expected, atol=1e-9)
    depth = dataset.true_depth(2)
    assert depth is not None
    assert share_wrong(depth, 2) < 0.02


def test_a_raw_drive_may_lie_flat_with_scans_of_some_frames_and_its_calibration_elsewhere(
    tmp_path: Path,
) -> None:
    drive = scans.write_raw(tmp_path / "drive", 5)
    flat = tmp_path / "piece/flat"
    flat.mkdir(parents=True)
    (drive / "image_02/data").rename(flat / "image_02")
    (drive / "velodyne_points/data").rename(flat / "velodyne_points")
    for frame in (1, 2, 3):
        (flat / f"velodyne_points/{frame:010d}.bin").unlink()
    dataset = KittiRaw(flat, tmp_path)
    assert [dataset.true_depth(frame) is None for frame in range(5)] == [0, 1, 1, 1, 0]
    np.testing.assert_allclose([f.time_s for f in dataset.frames()], 0.1 * np.arange(5))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-3])


def spoil(path: Path) -> None:
    points = np.frombuffer(path.read_bytes(), "<f4").copy()
    points[6] = np.nan
    path.write_bytes(points.tobytes())


def keep_first(folder: Path) -> None:
    for path in sorted(folder.glob("*.bin"))[1:]:
        path.unlink()


def empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def remove(folder: Path) -> None:
    empty(folder)
    folder.rmdir()


def drop_last_row(path: Path) -> None:
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))


SEQUENCE = "sequences/00"
FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no scans": (lambda r: remove(r / SEQUENCE / "velodyne"), "no folder .*velodyne; LiDAR needs"),
    "an empty folder": (
        lambda r: empty(r / SEQUENCE / "velodyne"),
        "no scans such as 000000.bin",
    ),
    "one scan": (lambda r: keep_first(r / SEQUENCE / "velodyne"), "is the only scan, need 2"),
    "a scan cut off": (
        lambda r: cut(r / SEQUENCE / "velodyne/000001.bin"),
        "000001.bin is no scan: .* bytes, need 16 for each point",
    ),
    "a scan of noise": (
        lambda r: spoil(r / SEQUENCE / "velodyne/000001.bin"),
        "000001.bin is no scan: points that are not finite",
    ),
    "no calibration": (lambda r: drop_last_row(r / SEQUENCE / "calib.txt"), "has no row Tr; take"),
}


@needs_kiss_icp
@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_scans_are_one_line(tmp_path: Path, fault: str) -> None:
    root = scans.write_kitti(tmp_path / "kitti", 3)
    damage, message = FAULTS[fault]
    damage(root)
    command = ["lidar", "kitti", "00", "--root", str(root), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*command, "--quiet"])
    assert result.exit_code == 1, result.output
    lines = [line for line in result.output.splitlines() if line.startswith("laser-slam:")]
    assert len(lines) == 1
    assert re.search(message, lines[0]), lines[0]


@needs_kiss_icp
@pytest.mark.parametrize("damage", [cut, lambda path: path.write_bytes(b"")], ids=["cut", "empty"])
def test_a_scan_that_is_cut_off_is_known_before_any_is_tracked(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    root, out = scans.write_kitti(tmp_path / "kitti", 3), tmp_path / "out"
    damage(root / SEQUENCE / "velodyne/000002.bin")
    command = ["lidar", "kitti", "00", "--root", str(root), "--out", str(out), "--quiet"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 1
    assert "000002.bin is no scan" in result.output
    assert not out.exists()


@needs_kiss_icp
@pytest.mark.parametrize(
    ("out", "words"), [(".", "is not empty; choose"), ("file/out", "Not a directory; choose")]
)
def test_a_folder_that_cannot_be_used_is_one_line(tmp_path: Path, out: str, words: str) -> None:
    root = scans.write_kitti(tmp_path / "kitti", 3)
    (tmp_path / "file").touch()
    command = ["lidar", "kitti", "00", "--root", str(root), "--out", str(tmp_path / out)]
    result = CliRunner().invoke(app, [*command, "--quiet"])
    assert result.exit_code == 1
    assert f"{words} another with --out" in result.stderr


def test_a_raw_drive_with_an_empty_folder_of_scans_is_read_without_depth(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    drive = scans.write_raw(tmp_path / "drive", 3)
    empty(drive / "velodyne_points/data")
    dataset = KittiRaw(drive)
    assert dataset.true_depth(0) is None
    assert "no depth from LiDAR: no scans such as 000000.bin" in caplog.text
    with pytest.raises(DatasetError, match=r"no scans such as 000000.bin"):
        dataset.velodyne()


def test_a_raw_drive_without_calibration_says_what_to_pass(tmp_path: Path) -> None:
    drive = scans.write_raw(tmp_path / "drive", 3)
    (tmp_path / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(DatasetError, match=r"no calib_cam_to_cam.txt in .*; pass --calibration"):
        KittiRaw(drive)
    with pytest.raises(DatasetError, match=r"cannot read .*; pass --calibration"):
        KittiRaw(drive, tmp_path)


def test_unrectified_images_are_refused(tmp_path: Path) -> None:
    drive = scans.write_raw(tmp_path / "drive", 3)
    for path in (drive / "image_02/data").iterdir():
        image = cv2.imread(str(path))
        assert image is not None
        cv2.imwrite(str(path), image[:-10])
    with pytest.raises(DatasetError, match=r"are 400x110, rectified ones of .* are 400x120; use"):
        KittiRaw(drive)


def test_kiss_icp_is_named_where_it_is_missing_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    import_kiss_icp.cache_clear()
    root, out = scans.write_kitti(tmp_path / "kitti", 3), tmp_path / "out"
    command = ["lidar", "kitti", "0", "--root", str(root), "--out", str(out), "--quiet"]
    result = CliRunner().invoke(app, command)
    import_kiss_icp.cache_clear()
    assert result.exit_code == 1, result.output
    assert "install it: pip install 'laser-slam[lidar]'" in result.output
    assert not out.exists()


def test_a_raw_drive_is_opened_by_its_date_alone(tmp_path: Path) -> None:
    drive = scans.write_raw(tmp_path / "drive", 3)
    for name in ("cam_to_cam", "velo_to_cam"):
        (tmp_path / f"calib_{name}.txt").unlink()
    for path in (drive / "image_02/data").iterdir():
        write_png(path, np.full((375, 1242, 3), 90, np.uint8))
    info = KittiRaw(drive, Path("2011_09_26")).info
    assert info.intrinsics_source == "KITTI's calibration of 2011_09_26, row P_rect_02"
    assert info.intrinsics is not None
    np.testing.assert_allclose(info.intrinsics[:, 2], [609.5593, 172.854, 1])
    with pytest.raises(DatasetError, match=r"or, for KITTI's own drives, the date: 2011_09_26, "):
        KittiRaw(drive)
    with pytest.raises(DatasetError, match=r"cannot read 2011_09_27/calib_cam_to_cam.txt"):
        KittiRaw(drive, Path("2011_09_27"))


@pytest.mark.parametrize("date", DAYS)
def test_a_date_stands_for_its_published_calibration(
    tmp_path: Path, date: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Checked by what no slip of a digit leaves as it is: rotations, and a rig built once."""
    monkeypatch.chdir(tmp_path)
    day, (width, height) = DAYS[date], DAYS[date].size
    for name in ("image_00", "image_02"):
        rig = raw_rig(Path(date), name, (height, width), "")
        ahead, left, up = rig.cam_from_velo[:3, :3].T
        assert ahead[2] > 0.999  # nearly where the camera looks
        assert min(-left[0], -up[1]) > 0.999
        assert np.abs(rig.cam_from_velo[:3, 3] - [0, -0.07, -0.3]).max() < 0.1
    for nine in (day.rotation_cam0_from_velo, day.rectified_from_cam0):
        R = np.reshape(nine, (3, 3))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=2e-6)
    with pytest.raises(DatasetError, match="are 100x100, rectified ones of"):
        raw_rig(Path(date), "image_02", (100, 100), "")


REAL = Path(os.environ.get("LASER_SLAM_DATA", ".")) / "kitti_raw_velo"
needs_data = pytest.mark.skipif(
    "LASER_SLAM_DATA" not in os.environ, reason="set LASER_SLAM_DATA to real data"
)


@needs_kiss_icp
@needs_data
def test_real_scans_give_the_path_of_kiss_icps_own_pipeline_and_reader(tmp_path: Path) -> None:
    folder = tmp_path / "sequences/11"
    (folder / "velodyne").mkdir(parents=True)
    paths = KittiRaw(REAL, Path("2011_09_26")).velodyne().paths
    for index, path in enumerate(paths.values()):
        (folder / f"velodyne/{index:06d}.bin").symlink_to(path)
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    reader = import_module("kiss_icp.datasets.kitti").KITTIOdometryDataset(str(tmp_path), "11")
    pipeline = import_module("kiss_icp.pipeline").OdometryPipeline(reader)
    pipeline._run_pipeline()
    ours = list(track_scans(Turn(f, raise_beams(read_scan(p))) for f, p in paths.items()))
    np.testing.assert_allclose(np.stack(ours), pipeline.poses, atol=1e-5)


@needs_kiss_icp
@needs_data
def test_real_scans_see_a_car_that_creeps_four_metres() -> None:
    dataset = KittiRaw(REAL, Path("2011_09_26"))
    path = track_camera(dataset.velodyne())
    assert path.frames.tolist() == [0, 4, 8, 12, 16]
    assert 3.5 < path.world_from_cam[-1, 2, 3] < 4.1
    depth = dataset.true_depth(0)
    assert depth is not None
    assert 0.03 < np.isfinite(depth).mean() < 0.05
