"""What pi3x may be told beside the images, before it gets into the network."""

from __future__ import annotations

import golden
import pytest
import torch
from torch import Tensor

from laser_slam.networks.conditioning import (
    depth_maps,
    make_camera_frames,
    mean_depths,
    ray_maps,
    relative_poses,
    turn,
)
from laser_slam.networks.upsampling import add_uv


def make_told() -> tuple[Tensor, Tensor, Tensor]:
    """Return depths, intrinsics, poses: a camera moves and turns before a wall with a hole."""
    depths = torch.full((1, 3, 56, 70), 2.0)
    depths[:, :, 20:40, 30:50] = 7
    depths[:, 1, :10] = torch.nan
    K = torch.tensor([[60.0, 0, 34.5], [0, 62, 27.5], [0, 0, 1]]).expand(1, 3, 3, 3)
    poses = torch.eye(4).repeat(1, 3, 1, 1)
    poses[0, :, 0, 3] = torch.tensor([1.0, 1.5, 2.5])
    c, s = torch.tensor(0.3).cos(), torch.tensor(0.3).sin()
    poses[0, 2, :3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return depths, K, poses


def test_heads_see_cameras_as_the_originals_do() -> None:
    known = {key: torch.from_numpy(value) for key, value in golden.load_functions().items()}
    frames = make_camera_frames(known["prope_c2w"][None], (2, 3), known["prope_in"].shape[-1])
    ways = {
        "prope_q": (frames.cam_from_window.mT, frames.forth),
        "prope_kv": (frames.window_from_cam, frames.forth),
        "prope_o": (frames.cam_from_window, frames.back),
    }
    for name, way in ways.items():
        found = turn(known["prope_in"], *way)
        assert golden.relative_difference(found, known[name].numpy()) < 2e-6, name


def test_places_in_the_image_are_the_originals() -> None:
    uv = add_uv(torch.zeros(1, 0, 4, 5), 70 / 56)[0].permute(1, 2, 0)
    known = golden.load_functions()["uv_grid_w5_h4_aspect70_56"]
    assert golden.relative_difference(uv, known) < 1e-6


def test_poses_alone_have_no_unit_but_still_cameras_stay_still() -> None:
    _, _, world_from_cam = make_told()
    near = world_from_cam.clone()
    near[..., :3, 3] *= 10
    alone = [relative_poses(poses, None) for poses in (world_from_cam, near)]
    torch.testing.assert_close(alone[0], alone[1])
    assert float(alone[0][:, 1:, :3, 3].norm(dim=-1).mean()) == pytest.approx(1)
    near[..., :3, 3] *= 1e-4
    still = relative_poses(near, None)[..., :3, 3].norm(dim=-1)
    assert 0 < float(still.max()) < 0.02


def test_depths_are_told_in_units_of_their_mean_and_gaps_are_marked() -> None:
    depths, _, _ = make_told()
    means = mean_depths(depths)
    known = depths[depths > 0]
    torch.testing.assert_close(means, known.mean()[None])
    maps = depth_maps(depths, means)
    assert maps.shape == (3, 2, 56, 70)
    assert bool((maps[1, :, :10] == 0).all())
    torch.testing.assert_close(maps[:, 0], depths[0].nan_to_num() / means)
    nothing = torch.full((1, 3, 56, 70), torch.nan)
    assert bool((depth_maps(nothing, mean_depths(nothing)) == 0).all())


def test_rays_pass_through_the_centres_of_pixels() -> None:
    _, intrinsics, _ = make_told()
    K = intrinsics[0, 0]
    rays = ray_maps(intrinsics, (56, 70))
    x, y = rays[0, :, 20, 30]
    u, v, _ = K @ torch.tensor([x, y, 1.0])
    assert (round(float(u), 4), round(float(v), 4)) == (30, 20)
