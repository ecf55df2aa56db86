import itertools
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.camera import project, unproject
from laser_slam.config import SyntheticConfig
from laser_slam.datasets.synthetic import mesh
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.paths import CAMERA_HEIGHT_M, loop_path, path_from_kitti_poses
from laser_slam.datasets.synthetic.save import save_kitti_layout
from laser_slam.datasets.synthetic.textures import band, make_textures, noise, pulse
from laser_slam.errors import DatasetError
from laser_slam.types import Frame

CONFIG = SyntheticConfig(num_frames=240, width=416, height=128)
STRAIGHT, TURN = 4, 45

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(CONFIG)


def poses_of(drive: SyntheticDrive) -> Array:
    assert drive.info.truth is not None
    return drive.info.truth.world_from_cam


def flow(drive: SyntheticDrive, first: int, second: int) -> Array:
    """Return the (H, W, 2) pixels of the second frame where the first one's points are."""
    poses, K = poses_of(drive), drive.info.intrinsics
    assert K is not None
    second_from_first = np.linalg.inv(poses[second]) @ poses[first]
    points = unproject(drive.true_depth(first), K)
    return project(points @ second_from_first[:3, :3].T + second_from_first[:3, 3], K)


def photometric_error(drive: SyntheticDrive, first: int, second: int, target: Array) -> float:
    """Return the median difference in grey levels, over what both frames can see."""
    grey = [cv2.cvtColor(drive.image(k), cv2.COLOR_RGB2GRAY) for k in (first, second)]
    x, y = (np.nan_to_num(target[..., k], nan=-9).astype(np.float32) for k in (0, 1))
    warped = cv2.remap(grey[1].astype(np.float32), x, y, cv2.INTER_LINEAR)
    height, width = grey[0].shape
    inside = (x > 1) & (x < width - 2) & (y > 1) & (y < height - 2)
    return float(np.median(np.abs(warped - grey[0])[inside]))


def test_the_same_seed_gives_the_same_pixels_in_any_order() -> None:
    config = SyntheticConfig(num_frames=30, width=160, height=64, seed=3)
    first, again = SyntheticDrive(config), SyntheticDrive(config)
    later = again.image(7)
    assert np.array_equal(again.image(0), first.image(0))
    assert np.array_equal(later, first.image(7))
    other = SyntheticDrive(config.model_copy(update={"seed": 4}))
    assert np.abs(other.image(0).astype(int) - first.image(0)).mean() > 8


def test_frames_come_in_order_with_the_promised_types(drive: SyntheticDrive) -> None:
    frames = list(itertools.islice(drive.frames(), 3))
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.time_s for frame in frames] == [0.0, 0.1, 0.2]
    for frame in frames:
        assert frame.image is not None
        assert frame.image.dtype == np.uint8
        assert frame.image.shape == (*drive.info.size, 3)
        assert np.array_equal(frame.image, drive.image(frame.index))
    depth = drive.true_depth(0)
    assert depth.dtype == np.float32
    assert depth.shape == drive.info.size


def test_the_sky_has_no_depth_and_the_road_has(drive: SyntheticDrive) -> None:
    depth = drive.true_depth(STRAIGHT)
    assert 0.01 < np.isnan(depth).mean() < 0.5
    assert np.isnan(depth[0]).any()
    assert np.isfinite(depth[-1]).all()
    # straight below the horizon, the road's depth is what the camera's height says
    focal, row = CONFIG.focal * CONFIG.width, CONFIG.height - 1
    expected = CAMERA_HEIGHT_M * focal / (row - (CONFIG.height - 1) / 2)
    assert depth[row, CONFIG.width // 2] == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("frame", [STRAIGHT, TURN])
def test_depth_and_poses_explain_the_next_image(drive: SyntheticDrive, frame: int) -> None:
    right = photometric_error(drive, frame, frame + 1, flow(drive, frame, frame + 1))
    wrong = photometric_error(drive, frame, frame + 1, flow(drive, frame, frame + 2))
    assert right < 4.0
    assert wrong > 1.8 * right


@pytest.mark.parametrize("frame", [STRAIGHT, TURN])
def test_corners_are_tracked_to_where_they_really_go(drive: SyntheticDrive, frame: int) -> None:
    grey = [cv2.cvtColor(drive.image(k), cv2.COLOR_RGB2GRAY) for k in (frame, frame + 1)]
    corners = cv2.goodFeaturesToTrack(grey[0], 400, 0.01, 6)
    assert len(corners) > 200
    at = corners[:, 0].round().astype(int)
    target = flow(drive, frame, frame + 1)[at[:, 1], at[:, 0]] + corners[:, 0] - at
    height, width = grey[0].shape
    stays = np.isfinite(target).all(1) & (target > 8).all(1)
    stays &= (target < (width - 8, height - 8)).all(1)
    guess = np.where(stays[:, None], target + 1.0, corners[:, 0]).astype(np.float32)[:, None]
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        *grey, corners, guess.copy(), winSize=(9, 9), maxLevel=2, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    error = np.linalg.norm(found[:, 0] - target, axis=1)[stays]
    good = (status[stays, 0] > 0) & (error < 2.0)
    assert good.mean() > 0.7
    assert np.median(error[good]) < 0.3


def matches(drive: SyntheticDrive, first: int, second: int) -> int:
    """Count the feature matches that one epipolar geometry explains."""
    orb = cv2.ORB_create(800, fastThreshold=8)
    a, b = (orb.detectAndCompute(drive.image(k), None) for k in (first, second))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a[1], b[1])
    pairs = [pair for pair in pairs if pair.distance < 50]
    if len(pairs) < 8:
        return 0
    left = np.array([a[0][pair.queryIdx].pt for pair in pairs])
    right = np.array([b[0][pair.trainIdx].pt for pair in pairs])
    _, inliers = cv2.findFundamentalMat(left, right, cv2.USAC_MAGSAC, 1.0, 0.999)
    return 0 if inliers is None else int(inliers.sum())


def test_the_drive_comes_back_and_sees_the_same_place(drive: SyntheticDrive) -> None:
    centres = poses_of(drive)[:, :3, 3]
    gap = np.linalg.norm(centres[200:, None] - centres[None, :60], axis=2)
    assert 0.12 < (gap.min(axis=1) < 2.0).sum() / len(centres) < 0.22
    again = 200 + int(np.argmin(gap[:, 10]))
    assert gap.min(axis=1)[-1] < 1.0
    assert matches(drive, 10, again) > 60
    assert matches(drive, 10, 120) < 0.5 * matches(drive, 10, again)


def test_the_path_is_a_smooth_drive_with_turns() -> None:
    for seed, num in ((0, 240), (1, 240), (2, 700), (3, 1500)):
        poses = loop_path(num, 0.9, seed)
        assert np.allclose(poses[0, :3, 3], 0)
        step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        assert step.mean() == pytest.approx(0.9, rel=0.02)
        assert 0.4 < step.min() < step.max() < 1.5
        relative = np.einsum("nji,njk->nik", poses[:-1, :3, :3], poses[1:, :3, :3])
        turn = np.degrees(np.arccos(np.clip((np.trace(relative, 0, 1, 2) - 1) / 2, -1, 1)))
        assert 2.0 < turn.max() < 7.0
        heading = np.degrees(np.unwrap(np.arctan2(poses[:, 0, 2], poses[:, 2, 2])))
        assert np.ptp(heading) > 350


@pytest.mark.parametrize("seed", [0, 5])
def test_nothing_stands_in_the_way(seed: int) -> None:
    small = SyntheticDrive(SyntheticConfig(num_frames=240, width=96, height=32, seed=seed))
    for frame in range(0, 240, 3):
        depth = small.true_depth(frame)
        ahead = depth[10:22, 36:60]
        assert not (ahead < 1.5).any(), f"frame {frame}"
        below = depth[-1, 48]  # a car's roof or a hedge would be nearer than the road
        assert 4.0 < below < 9.0, f"frame {frame}"


def test_the_world_follows_a_given_path_and_closes_the_horizon() -> None:
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 2, 3] = np.arange(40) * 1.2
    poses[:, 1, 3] = -0.05 * poses[:, 2, 3]  # uphill
    drive = SyntheticDrive(SyntheticConfig(width=160, height=64), path_from_kitti_poses(poses))
    assert drive.info.num_frames == 40
    depth = drive.true_depth(20)
    assert depth[-1, 80] == pytest.approx(CAMERA_HEIGHT_M / 0.34, rel=0.25)
    assert np.nanmax(depth) < 400


def test_a_camera_that_stands_still_sees_a_street() -> None:
    drive = SyntheticDrive(SyntheticConfig(width=96, height=32), np.tile(np.eye(4), (3, 1, 1)))
    assert np.isfinite(drive.true_depth(2)[-1]).all()


def test_a_path_over_a_bridge_is_refused() -> None:
    num = 120
    angle = np.linspace(0, 2.4 * np.pi, num)
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = 30 - 30 * np.cos(angle), 30 * np.sin(angle)
    poses[:, 1, 3] = np.linspace(0, 16, num)
    with pytest.raises(DatasetError, match=r"passes the place of frame .*shorten the path"):
        SyntheticDrive(SyntheticConfig(width=96, height=32), poses)


def test_a_drifting_height_is_levelled_where_the_path_comes_by_again() -> None:
    num = 120
    angle = np.linspace(0, 2.4 * np.pi, num)
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = 30 - 30 * np.cos(angle), 30 * np.sin(angle)
    poses[:, 1, 3] = np.linspace(0, 4, num)
    drive = SyntheticDrive(SyntheticConfig(width=96, height=32), poses)
    rendered = poses_of(drive)
    assert np.array_equal(rendered[:, [0, 2], 3], poses[:, [0, 2], 3])
    assert abs(rendered[5, 1, 3] - rendered[105, 1, 3]) < 1.2  # 3.4 m as given
    for frame in (5, 60, 105):
        assert 4.0 < drive.true_depth(frame)[-1, 48] < 9.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1\n", "line 1 has 11 numbers, KITTI poses have 12"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 nan 0 1 0 0 0 0 1 0\n", "pose 1 .* not finite"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n", "pose 1 .* no rotation"),
        ("one two\n", "no KITTI poses file"),
        ("", "two or more"),
    ],
)
def test_a_bad_poses_file_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(DatasetError, match=message):
        SyntheticDrive.from_poses_file(path, CONFIG)


def test_a_missing_poses_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"cannot read poses file .*none.txt: No such file"):
        SyntheticDrive.from_poses_file(tmp_path / "none.txt", CONFIG)


def test_filters_agree_with_counting() -> None:
    fine = np.linspace(0.8, 2.0, 20001)  # the interval of width 1.2 around 1.4
    assert band(1.4, 0.9, 1.3, 1.2) == pytest.approx(((fine > 0.9) & (fine < 1.3)).mean(), abs=1e-3)
    assert pulse(1.4, 0.5, 0.2, 1.2) == pytest.approx((fine % 0.5 < 0.2).mean(), abs=1e-3)


def test_noise_fades_with_the_footprint() -> None:
    textures = make_textures(0)
    spots = np.random.default_rng(0).uniform(0, 1, (400, 2))
    spread = [
        np.std([noise(textures, 0, x, y, footprint) for x, y in spots])
        for footprint in (1 / 512, 1 / 64, 1 / 8)
    ]
    assert spread[0] > 1.5 * spread[1] > 2 * spread[2]
    assert noise(textures, 0, 0.3, 0.4, 0.001) == pytest.approx(
        noise(textures, 0, 5.3, -2.6, 0.001)
    )


def test_one_material_each() -> None:
    names = ("GROUND", "PAVEMENT", "KERB", "WALL", "ROOF", "LEAF", "BARK", "PLAIN", "PAINT")
    names += ("CAR_SIDE", "GLASS", "TYRE", "SIGN")
    assert len({getattr(mesh, name) for name in names}) == 13


def test_a_saved_drive_reads_back(tmp_path: Path) -> None:
    drive = SyntheticDrive(SyntheticConfig(num_frames=4, width=96, height=32))
    save_kitti_layout(drive, tmp_path, "07")
    folder = tmp_path / "sequences" / "07"
    assert sorted(path.name for path in (folder / "image_2").iterdir()) == [
        f"{k:06d}.png" for k in range(4)
    ]
    image = cv2.imread(str(folder / "image_2" / "000002.png"))
    assert np.array_equal(image[..., ::-1], drive.image(2))
    steps = cv2.imread(str(folder / "depth" / "000002.png"), cv2.IMREAD_UNCHANGED)
    depth = drive.true_depth(2)
    assert steps.dtype == np.uint16
    known = np.isfinite(depth) & (depth < 250)
    assert np.abs(steps[known] / 256 - depth[known]).max() < 1 / 256
    assert (steps[np.isnan(depth)] == 0).all()
    poses = np.loadtxt(tmp_path / "poses" / "07.txt").reshape(-1, 3, 4)
    assert np.allclose(poses, poses_of(drive)[:, :3], atol=1e-7)
    assert np.allclose(np.loadtxt(folder / "times.txt"), np.arange(4) / 10)
    lines = (folder / "calib.txt").read_text().splitlines()
    assert [line[:3] for line in lines] == ["P0:", "P1:", "P2:", "P3:"]
    K = np.array(lines[0].split()[1:], float).reshape(3, 4)[:, :3]
    assert np.allclose(K, drive.info.intrinsics)
    with pytest.raises(DatasetError, match=r"sequence 07 is in .* already; remove it"):
        save_kitti_layout(drive, tmp_path, "07")


class BreaksOff(SyntheticDrive):
    def frames(self) -> Iterator[Frame]:
        yield from itertools.islice(super().frames(), 2)
        raise KeyboardInterrupt


def test_an_interrupted_save_leaves_nothing(tmp_path: Path) -> None:
    drive = BreaksOff(SyntheticConfig(num_frames=4, width=96, height=32))
    with pytest.raises(KeyboardInterrupt):
        save_kitti_layout(drive, tmp_path, "00")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert list((tmp_path / "sequences").iterdir()) == []
