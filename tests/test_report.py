"""Pictures: right geometry, whole labels, and something to see even of odd input."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from laser_slam.camera import intrinsics_from_fov, intrinsics_matrix, project
from laser_slam.errors import RunFolderError
from laser_slam.report import (
    CloudView,
    Viewpoint,
    cloud_picture,
    depth_picture,
    drift_picture,
    render_points,
    stages_picture,
    trajectory_picture,
)
from laser_slam.report.splat import project_points
from laser_slam.report.viewpoints import from_above, from_bird, from_driver
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import Cloud, Trajectory

SIZE = (60, 80)
WHITE = np.full((*SIZE, 3), 255, np.uint8)


def cloud_of(points: np.ndarray, color: tuple[int, int, int], voxel_size: float) -> Cloud:
    colors = np.tile(np.array(color, np.uint8), (len(points), 1))
    return Cloud(points, colors, np.ones(len(points), np.float32), voxel_size)


def wall(z: float, color: tuple[int, int, int], half: float, step: float = 0.02) -> Cloud:
    """Make a square wall of points that faces the camera at distance ``z``."""
    side = np.arange(-half, half, step)
    x, y = np.meshgrid(side, side)
    return cloud_of(np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3), color, step)


def join(*clouds: Cloud) -> Cloud:
    return Cloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate([cloud.colors for cloud in clouds]),
        np.concatenate([cloud.weights for cloud in clouds]),
        clouds[0].voxel_size,
    )


def camera(size: tuple[int, int] = SIZE) -> Viewpoint:
    return Viewpoint(np.eye(4), intrinsics_from_fov(60, *size), size)


def drive(num: int = 30, *, metres: float = 60.0) -> Trajectory:
    """Make a drive along a gentle curve, in the world of its first camera."""
    turn = np.linspace(0, 0.6, num)
    world_from_cam = np.tile(np.eye(4), (num, 1, 1))
    world_from_cam[:, :3, :3] = [rotation_exp(np.array([0, angle, 0])) for angle in turn]
    radius = metres / 0.6
    world_from_cam[:, 0, 3] = radius * (1 - np.cos(turn))
    world_from_cam[:, 2, 3] = radius * np.sin(turn)
    return Trajectory(np.arange(num), 0.1 * np.arange(num), world_from_cam)


def street_around(trajectory: Trajectory) -> Cloud:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, len(trajectory.frames), 20_000)
    local = rng.uniform([-6, -3, 0], [6, 1.6, 12], (20_000, 3))
    local[:, 1] = np.where(np.abs(local[:, 0]) < 5, 1.6, local[:, 1])
    poses = trajectory.world_from_cam[frames]
    points = (poses[:, :3, :3] @ local[:, :, None])[..., 0] + poses[:, :3, 3]
    return Cloud(points, rng.integers(0, 200, (20_000, 3), dtype=np.uint8), np.ones(20_000), 0.15)


def read(path: Path) -> np.ndarray:
    return np.asarray(PIL.Image.open(path).convert("RGB"))


def test_points_fall_on_the_pixels_of_the_pinhole_model() -> None:
    rng = np.random.default_rng(1)
    world_from_cam = Sim3(1, rotation_exp(rng.normal(size=3)), rng.normal(size=3)).matrix()
    viewpoint = Viewpoint(world_from_cam, intrinsics_from_fov(60, *SIZE), SIZE)
    local = rng.uniform([-1, -1, -1], [1, 1, 4], (200, 3))
    world = local @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    pixels = project_points(world, viewpoint)
    front = local[:, 2] > 0
    expected = project(local[front], viewpoint.intrinsics)
    np.testing.assert_allclose(pixels[front, :2], expected, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(pixels[front, 2], local[front, 2], rtol=1e-5)
    assert (pixels[~front, 2] == 0).all()


@pytest.mark.parametrize("parallel", [False, True])
def test_the_depth_buffer_agrees_with_a_slow_one(parallel: bool) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([-2, -2, 1], [2, 2, 6], (300, 3))
    intrinsics = intrinsics_matrix(15, 15, 39.5, 29.5) if parallel else camera().intrinsics
    viewpoint = Viewpoint(np.eye(4), intrinsics, SIZE, parallel=parallel)
    focal, voxel_size = intrinsics[0, 0], 0.1
    slow = np.full(SIZE, np.inf)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    for x, y, z in points:
        divisor = 1 if parallel else z
        radius = max(0.75 * voxel_size * focal / divisor, 0.5)
        column, row = focal * x / divisor + intrinsics[0, 2], focal * y / divisor + 29.5
        box = (np.abs(u - column) <= radius) & (np.abs(v - row) <= radius)
        disc = box & ((u - column) ** 2 + (v - row) ** 2 <= radius**2 + 0.25)
        slow[disc] = np.minimum(slow[disc], z)
    image, depth = render_points(cloud_of(points, (9, 9, 9), voxel_size), viewpoint, WHITE)
    seen = np.isfinite(slow)
    np.testing.assert_allclose(depth[seen], slow[seen], rtol=1e-6)
    assert (image[~np.isfinite(depth)] == 255).all()
    assert (image[seen] <= 9).all()


def test_a_near_wall_hides_a_far_one_without_gaps() -> None:
    both = join(wall(2.0, (200, 0, 0), 0.5), wall(4.0, (0, 0, 200), 4.0))
    image, depth = render_points(both, camera(), WHITE, shade=0.0)
    rows, columns = np.nonzero(depth < 3)
    inside = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert len(rows) > 400
    assert (image[inside] == [200, 0, 0]).all()
    assert (image[depth > 3] == [0, 0, 200]).all()
    assert np.isfinite(depth).all()


def test_colours_of_one_surface_are_mixed_and_small_holes_filled() -> None:
    dark, light = wall(2.0, (50, 50, 50), 2.0), wall(2.001, (150, 150, 150), 2.0)
    mixed = join(dark, light)
    missing = np.linalg.norm(mixed.points[:, :2], axis=1) < 0.04
    kept = Cloud(mixed.points[~missing], mixed.colors[~missing], mixed.weights[~missing], 0.02)
    image, depth = render_points(kept, camera(), WHITE, shade=0.0)
    assert np.isfinite(depth).all()
    np.testing.assert_allclose(image, 100, atol=20)  # one disc more of one colour than the other


def test_depth_steps_are_shaded_and_flat_walls_are_not() -> None:
    far = wall(4.0, (200, 200, 200), 4.0)
    flat, _ = render_points(far, camera(), WHITE)
    assert (flat == 200).all()
    image, depth = render_points(join(wall(2.0, (200, 200, 200), 0.5), far), camera(), WHITE)
    assert image[depth > 3].min() < 150
    assert np.median(image) == 200


def test_the_unit_of_the_world_does_not_show() -> None:
    trajectory = drive()
    cloud = street_around(trajectory)
    for place in (from_above, from_bird, from_driver):
        views = []
        for unit in (1.0, 128.0):
            poses = trajectory.world_from_cam.copy()
            poses[:, :3, 3] *= unit
            scaled = Trajectory(trajectory.frames, trajectory.times_s, poses)
            other = Cloud(cloud.points * unit, cloud.colors, cloud.weights, cloud.voxel_size * unit)
            viewpoint = place(other, scaled)
            paper = np.full((*viewpoint.size, 3), 255, np.uint8)
            views.append(render_points(other, viewpoint, paper)[0])
        assert views[0].shape == views[1].shape
        assert (np.abs(views[0].astype(int) - views[1]) > 3).mean() < 0.01
        assert (views[0] < 255).mean() > 0.02


@pytest.mark.parametrize("place", [from_above, from_bird])
def test_the_whole_map_fits_into_the_picture(place: object) -> None:
    trajectory = drive()
    cloud = street_around(trajectory)
    viewpoint = place(cloud, trajectory)  # type: ignore[operator]
    everything = np.concatenate([cloud.points, trajectory.world_from_cam[:, :3, 3]])
    pixels = project_points(everything, viewpoint)
    height, width = viewpoint.size
    inside = (pixels[:, :2] >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    assert (inside & (pixels[:, 2] > 0)).mean() > 0.99
    assert inside[len(cloud.points) :].all()
    used = np.ptp(pixels[inside, :2], axis=0) / (width, height)
    assert used.max() > 0.85


def test_above_means_up_is_nearer_and_forward_is_up_or_to_the_right() -> None:
    plane = np.random.default_rng(0).uniform([-50.0, 1, -5], [50, 1, 5], (2000, 3))
    wide = cloud_of(plane, (0, 0, 0), 0.1)
    viewpoint = from_above(wide, drive(metres=1.0))
    right, ahead, high = (
        project_points(np.array([point]), viewpoint)[0]
        for point in ([20.0, 1, 0], [0.0, 1, 4], [0.0, -2, 0])
    )
    middle = project_points(np.array([[0.0, 1, 0]]), viewpoint)[0]
    assert right[0] > middle[0] + 50
    assert ahead[1] < middle[1] - 10
    assert high[2] < middle[2]
    tall = cloud_of(wide.points[:, [2, 1, 0]], (0, 0, 0), 0.1)
    viewpoint = from_above(tall, drive(metres=1.0))
    ahead = project_points(np.array([[0.0, 1, 20]]), viewpoint)[0]
    assert ahead[0] > project_points(np.array([[0.0, 1, 0]]), viewpoint)[0, 0] + 50


def test_the_driver_looks_along_a_camera_from_behind() -> None:
    trajectory = drive()
    viewpoint = from_driver(street_around(trajectory), trajectory)
    offsets = viewpoint.world_from_cam[:3, 3] - trajectory.world_from_cam[:, :3, 3]
    nearest = np.linalg.norm(offsets, axis=1).argmin()
    look = viewpoint.world_from_cam[:3, 2]
    behind = [-offset @ look for offset in offsets[: nearest + 5]]
    assert max(behind) > 0
    assert (trajectory.world_from_cam[:, :3, 2] @ look).max() == pytest.approx(1.0)


@pytest.mark.parametrize("metres", [40.0, 4000.0])
def test_the_driver_stays_on_the_road_however_long_the_map_is(metres: float) -> None:
    num = round(metres)
    world_from_cam = np.tile(np.eye(4), (num, 1, 1))
    world_from_cam[:, 2, 3] = np.arange(num)
    trajectory = Trajectory(np.arange(num), 0.1 * np.arange(num), world_from_cam)
    rng = np.random.default_rng(0)
    points = rng.uniform([-8, -3, 0], [8, 1.6, metres], (50 * num, 3))
    points[:, 1] = np.where(np.abs(points[:, 0]) < 7, 1.6, points[:, 1])
    viewpoint = from_driver(cloud_of(points, (90, 90, 90), 0.2), trajectory)
    offsets = viewpoint.world_from_cam[:3, 3] - world_from_cam[:, :3, 3]
    assert np.linalg.norm(offsets[:, :2], axis=1).min() < 1.5
    behind = viewpoint.world_from_cam[:3, 3] - world_from_cam[0, :3, 3]
    assert behind[2] > -4


@pytest.mark.parametrize("view", list(CloudView))
@pytest.mark.parametrize("num", [0, 1, 20_000])
def test_clouds_of_any_size_give_a_picture(tmp_path: Path, view: CloudView, num: int) -> None:
    trajectory = drive(num=max(1, min(num, 30)))
    whole = street_around(drive())
    cloud = Cloud(whole.points[:num], whole.colors[:num], whole.weights[:num])  # size unknown
    cloud_picture(tmp_path / "cloud.png", cloud, trajectory, view, unit="m")
    image = read(tmp_path / "cloud.png")
    assert image.shape[1] == 1200
    assert image.std() > (20 if num > 1 else 0.5)


def test_no_label_touches_the_border(tmp_path: Path) -> None:
    truth = drive(metres=2345.0)
    shifted = truth.world_from_cam.copy()
    shifted[:, :3, 3] += 12_345.0
    estimate = Trajectory(truth.frames, truth.times_s, shifted)
    partly = Trajectory(truth.frames[::3], truth.times_s[::3], truth.world_from_cam[::3])
    paths = [tmp_path / f"{i}.png" for i in range(6)]
    trajectory_picture(paths[0], truth, truth)
    trajectory_picture(paths[1], estimate, partly)
    trajectory_picture(paths[2], estimate, None)
    drift_picture(paths[3], np.linspace(0, 3723, 50), 1e4 * np.random.default_rng(0).random(50))
    stages_picture(paths[4], {"a stage with a rather long name": 12345.6, "short": 0.0})
    image = np.zeros((40, 120, 3), np.uint8)
    depth_picture(paths[5], [image] * 2, [np.ones((20, 60))] * 2, [np.ones((20, 60))] * 2)
    for path in paths:
        pixels = read(path)
        assert pixels.shape[1] == 1200
        assert (pixels < 200).any()
        border = np.concatenate([pixels[:4], pixels[-4:]], axis=0), pixels[:, :4], pixels[:, -4:]
        assert all((strip == 255).all() for strip in border), path.name


def test_odd_input_still_gives_a_picture(tmp_path: Path) -> None:
    standing = Trajectory(np.arange(3), np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    elsewhere = Trajectory(np.arange(10, 13), np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    trajectory_picture(tmp_path / "standing.png", standing, None)
    trajectory_picture(tmp_path / "no-common-frame.png", standing, elsewhere)
    drift_picture(tmp_path / "unknown.png", np.arange(3.0), np.full(3, np.nan))
    drift_picture(tmp_path / "empty.png", np.zeros(0), np.zeros(0))
    stages_picture(tmp_path / "none.png", {})
    stages_picture(tmp_path / "nothing.png", {"reading": 0.0})
    unknown = np.full((20, 30), np.nan, np.float32)
    grey = np.zeros((20, 30, 3), np.uint8)
    depth_picture(tmp_path / "unknown-depth.png", [grey], [unknown], [np.zeros((20, 30))])
    depth_picture(tmp_path / "no-frame.png", [], [], [])
    assert len(list(tmp_path.glob("*.png"))) == 8


def test_the_sheet_shows_near_as_red_far_as_blue_and_unknown_as_grey(tmp_path: Path) -> None:
    depth = np.repeat(np.geomspace(1, 50, 90, dtype=np.float32)[None], 60, axis=0)
    depth[:, 80:] = np.nan
    image = np.full((60, 90, 3), 77, np.uint8)
    depth_picture(tmp_path / "sheet.png", [image], [depth], [np.full((60, 90), 0.5)])
    sheet = read(tmp_path / "sheet.png").astype(int)
    row = sheet[sheet.shape[0] // 2]
    assert (row[200] == 77).all()
    near, far, unknown = row[425], row[700], row[780]
    assert near[0] > near[2] + 50
    assert far[2] > far[0] + 10
    assert np.ptp(unknown) < 15
    assert unknown.max() < 80


def test_a_missing_folder_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"x\.png: No such file or directory; create"):
        stages_picture(tmp_path / "nowhere" / "x.png", {"reading": 1.0})


def test_no_global_state_of_the_plotting_package_is_used() -> None:
    code = "import laser_slam.report, sys; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
