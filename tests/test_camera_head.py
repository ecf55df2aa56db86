"""Decoding cameras, against the original and against geometry."""

from __future__ import annotations

import golden
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from laser_slam.networks.camera_head import (
    NUM_STEPS,
    CameraHead,
    CameraHeadConfig,
    decode_cameras,
    rotation_matrices,
)

WIDTH = 32


@pytest.fixture(scope="module")
def head() -> CameraHead:
    head = CameraHead(WIDTH, CameraHeadConfig(2, 2))
    golden.fill(head, "camera_head.")
    return head.eval()


def random_tokens(seed: int, num_frames: int = 3) -> Tensor:
    return torch.randn(2, num_frames, WIDTH, generator=torch.Generator().manual_seed(seed))


def test_cameras_are_decoded_as_the_original_does() -> None:
    known = golden.load_functions()
    height, width = (int(side) for side in known["pose_enc_image_hw"])
    cameras = decode_cameras(torch.from_numpy(known["pose_enc_in"]), (height, width))
    expected = known["pose_enc_extrinsic_w2c"]
    assert golden.relative_difference(cameras.cam_from_world[..., :3, :], expected) < 1e-6
    assert golden.relative_difference(cameras.intrinsics, known["pose_enc_intrinsic"]) < 1e-6
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(1, 6, -1)
    assert torch.equal(cameras.cam_from_world[..., 3, :], last)


@pytest.mark.parametrize("length", [0.01, 1.0, 30.0])
def test_the_length_of_a_quaternion_does_not_matter(length: float) -> None:
    rotations = Rotation.random(20, random_state=0)
    quat_xyzw = torch.from_numpy(length * rotations.as_quat())
    np.testing.assert_allclose(rotation_matrices(quat_xyzw), rotations.as_matrix(), atol=1e-12)


def test_the_edges_of_an_image_are_half_the_angle_of_view_off_its_axis() -> None:
    angles = torch.tensor([0.5, 1.2])  # from top to bottom, from left to right
    encoded = torch.cat([torch.tensor([0.0, 0, 0, 0, 0, 0, 1]), angles])
    intrinsics = decode_cameras(encoded, (154, 518)).intrinsics
    top = torch.linalg.inv(intrinsics) @ torch.tensor([259.0, 0.0, 1.0])
    left = torch.linalg.inv(intrinsics) @ torch.tensor([0.0, 77.0, 1.0])
    np.testing.assert_allclose(top, [0, -np.tan(0.25), 1], atol=1e-6)
    np.testing.assert_allclose(left, [-np.tan(0.6), 0, 1], atol=1e-6)


@torch.no_grad()
def test_an_angle_below_zero_is_reported_as_none_but_corrected_as_it_is(head: CameraHead) -> None:
    changes: list[Tensor] = []
    looked_at: list[Tensor] = []
    hooks = [
        head.pose_branch.register_forward_hook(lambda _m, _i, out: changes.append(out)),
        head.embed_pose.register_forward_hook(lambda _m, inputs, _o: looked_at.append(inputs[0])),
    ]
    offset = head.pose_branch.fc2.bias[-2:].clone()
    head.pose_branch.fc2.bias[-2:] -= torch.tensor([0.5, 0.0])
    steps = head(random_tokens(0))
    head.pose_branch.fc2.bias[-2:] = offset
    for hook in hooks:
        hook.remove()
    sums = torch.stack(changes).cumsum(0)
    assert bool((sums[:-1, ..., 7] < -0.1).any())
    torch.testing.assert_close(steps[..., :7], sums[..., :7])
    torch.testing.assert_close(steps[..., 7:], sums[..., 7:].clamp(min=0))
    torch.testing.assert_close(torch.stack(looked_at[1:]), sums[:-1])


@torch.no_grad()
def test_frames_of_a_window_see_one_another_but_not_their_order(head: CameraHead) -> None:
    tokens = random_tokens(1)
    order = [2, 0, 1]
    steps = head(tokens)
    assert steps.shape == (NUM_STEPS, 2, 3, 9)
    torch.testing.assert_close(head(tokens[:, order]), steps[:, :, order], rtol=0, atol=1e-6)
    assert float((head(tokens[:, :2]) - steps[:, :, :2]).abs().max()) > 1e-4
    torch.testing.assert_close(head(tokens[:1]), steps[:, :1], rtol=0, atol=1e-6)
