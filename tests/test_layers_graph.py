"""The graph of layers: its edges, and the way of scales along them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix, rays
from laser_slam.layers.alignment_kernels import carry_labels, count_pairs
from laser_slam.layers.graph import Edges, first_rows, inter_window_edges, intra_window_edges
from laser_slam.layers.propagation import propagate
from laser_slam.layers.tracks import Pieces, join_frames, link_tracks
from laser_slam.sim3 import rotation_exp
from laser_slam.types import Prediction

Labels = NDArray[np.uint16]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
SIZE = (40, 64)


def random_labels(rng: np.random.Generator, num_frames: int, num_layers: int = 6) -> Labels:
    """Rectangles over each other, labels from 1 without gaps, a tenth unknown."""
    out = np.ones((num_frames, *SIZE), np.uint16)
    for labels in out:
        for k in range(2, num_layers + 1):
            v, u = rng.integers(0, SIZE[0] - 12), rng.integers(0, SIZE[1] - 16)
            labels[v : v + 12, u : u + 16] = k
        labels[rng.random(SIZE) < 0.1] = 0
        old, places = np.unique(np.append(labels.ravel(), 0), return_inverse=True)
        labels[:] = places[:-1].reshape(SIZE)
        assert labels.max() == len(old) - 1
    return out


def edges_by_masks(before: Labels, here: Labels, tau: float) -> dict[tuple[int, int], float]:
    """Compare every two layers by their boolean masks: slow and obvious."""
    out = {}
    known = (before > 0) & (here > 0)
    for m in range(1, int(before.max()) + 1):
        for n in range(1, int(here.max()) + 1):
            first, second = (before == m) & known, (here == n) & known
            union = int((first | second).sum())
            iou = int((first & second).sum()) / union if union else 0.0
            if iou > tau:
                out[m, n] = iou
    return out


def as_table(edges: Edges, frame: int, first: int, second: int) -> dict[tuple[int, int], float]:
    """Return {(parent's label, child's label): IoU} of one frame's edges."""
    here = edges.chosen(edges.frame == frame)
    names = zip((here.parent - first + 1).tolist(), (here.child - second + 1).tolist(), strict=True)
    return dict(zip(names, here.iou.tolist(), strict=True))


# --- edges --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_pairs_of_labels_are_counted_as_masks_count_them(seed: int) -> None:
    first, second = random_labels(np.random.default_rng(seed), 2)
    counts = count_pairs(first, second, int(first.max()), int(second.max()))
    assert counts.shape == (first.max() + 1, second.max() + 1)
    for m, n in np.ndindex(counts.shape):
        assert counts[m, n] == ((first == m) & (second == n)).sum()


def test_layers_are_counted_through_all_frames() -> None:
    labels = np.zeros((3, 2, 2), np.uint16)
    labels[0, 0], labels[2, 0, 0] = [1, 2], 1
    assert first_rows(labels).tolist() == [0, 2, 2, 3]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("tau", [0.0, 0.1, 0.3, 0.6])
def test_windows_are_linked_where_masks_overlap_more_than_tau(seed: int, tau: float) -> None:
    rng = np.random.default_rng(seed)
    before, here = random_labels(rng, 4), random_labels(rng, 3)
    here[0] = np.where(rng.random(SIZE) < 0.8, before[2], 0)  # the same layers, mostly
    here[0, 0, :8] = np.arange(1, 9).clip(max=before[2].max())  # no gaps
    starts = first_rows(before), first_rows(here)
    in_a, in_b = np.array([2, 3]), np.array([0, 1])
    edges = inter_window_edges((before, starts[0], in_a), (here, starts[1], in_b), tau)
    for i, j in zip(in_a, in_b, strict=True):
        expected = edges_by_masks(before[i], here[j], tau)
        found = as_table(edges, int(j), int(starts[0][i]), int(starts[1][j]))
        assert found == pytest.approx(expected)
    assert len(edges) > 0
    assert edges.iou.min() > tau


@pytest.mark.parametrize("seed", range(4))
def test_frames_are_linked_where_masks_overlap_more_than_tau(seed: int) -> None:
    labels = random_labels(np.random.default_rng(seed), 4)
    starts = first_rows(labels)
    edges = intra_window_edges(labels, starts, 0.2, None, 1)
    for i in range(1, 4):
        expected = edges_by_masks(labels[i - 1], labels[i], 0.2)
        assert as_table(edges, i, int(starts[i - 1]), int(starts[i])) == pytest.approx(expected)
    assert (np.diff(edges.frame) >= 0).all()


def test_an_overlap_of_exactly_tau_is_no_edge() -> None:
    first = np.ones((1, 4, 4), np.uint16)
    second = np.repeat([1, 2], 2).astype(np.uint16).reshape(1, 1, 4).repeat(4, axis=1)
    at = np.array([0])
    sides = (first, first_rows(first), at), (second, first_rows(second), at)
    assert len(inter_window_edges(*sides, tau=0.5)) == 0
    assert len(inter_window_edges(*sides, tau=0.499)) == 2


def test_what_is_unknown_in_one_frame_neither_links_nor_divides() -> None:
    """Half of a layer is unknown in the other frame: the rest agrees wholly."""
    first = np.ones((1, 4, 6), np.uint16)
    second = first.copy()
    second[0, :, 3:] = 0
    at = np.array([0])
    edges = inter_window_edges((first, first_rows(first), at), (second, first_rows(second), at), 0)
    assert edges.iou.tolist() == [1.0]
    nothing = np.zeros_like(first)
    sides = (first, first_rows(first), at), (nothing, first_rows(nothing), at)
    assert len(inter_window_edges(*sides, tau=0.0)) == 0


# --- labels carried along by depth and poses ----------------------------------------------------

K = intrinsics_matrix(50.0, 52.0, 31.5, 19.5)
NEAR, FAR = 4.0, 9.0


def board_seen_from(world_from_cam: Array) -> tuple[NDArray[np.float32], Labels, Array]:
    """See a striped wall with a board before it: depth, label and world point of each pixel."""
    directions = rays(K, *SIZE) @ world_from_cam[:3, :3].T
    center = world_from_cam[:3, 3]
    near, far = ((z - center[2]) / directions[..., 2] for z in (NEAR, FAR))
    on_board = center + directions * near[..., None]
    is_board = (np.abs(on_board[..., 0]) < 1.0) & (np.abs(on_board[..., 1]) < 0.8)
    depth = np.where(is_board, near, far)
    points = center + directions * depth[..., None]
    return depth.astype(np.float32), labels_at(points, is_board), points


def labels_at(points: Array, is_board: NDArray[np.bool_]) -> Labels:
    stripes = 2 + np.floor(points[..., 0]).astype(int) + 12
    return np.where(is_board, 1, stripes).astype(np.uint16)


def moved_camera(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = rotation_exp(0.05 * rng.normal(size=3))
    world_from_cam[:3, 3] = rng.uniform([-1.0, -0.5, -0.5], [1.0, 0.5, 0.5])
    return world_from_cam


def window_of(poses: list[Array], block: int = 1) -> tuple[Prediction, Labels]:
    views = [board_seen_from(pose) for pose in poses]
    depth = np.stack([view[0] for view in views])
    window = Prediction(
        np.arange(len(poses)),
        depth,
        np.ones_like(depth),
        np.stack(poses),
        np.tile(K, (len(poses), 1, 1)),
    )
    return window, np.stack([view[1] for view in views])[:, ::block, ::block]


def carry(window: Prediction, labels: Labels, block: int) -> Labels:
    """Carry the labels of frame 0 to frame 1, with the projection written as in a textbook."""
    there_from_here = np.linalg.inv(window.window_from_cam[0]) @ window.window_from_cam[1]
    M = np.column_stack(
        [K @ there_from_here[:3, :3] @ np.linalg.inv(K), K @ there_from_here[:3, 3]]
    )
    there, here = window.depth[:, ::block, ::block]
    out: Labels = carry_labels(labels[0], there, here, M, block)
    return out


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_labels_are_carried_to_where_the_next_frame_sees_their_points(
    seed: int, block: int
) -> None:
    poses = [np.eye(4), moved_camera(seed)]
    window, labels = window_of(poses, block)
    carried = carry(window, labels, block)
    points = board_seen_from(poses[1])[2][::block, ::block]
    homogeneous = points @ K.T
    pixels = homogeneous[..., :2] / homogeneous[..., 2:]
    cell = np.floor(pixels / block + 0.5).astype(int)
    height, width = labels.shape[1:]
    inside = np.all((cell >= 0) & (cell < [width, height]), axis=2)
    u, v = np.where(inside[..., None], cell, 0).transpose(2, 0, 1)
    seen = inside & (np.abs(window.depth[0][::block, ::block][v, u] / points[..., 2] - 1) < 0.15)
    assert 0.4 < seen.mean() < 1
    # A point half way between two pixels may be rounded either way.
    expected = np.where(seen, labels[0][v, u], 0)
    assert (carried == expected).mean() > 0.998
    # Rounding to the nearest cell is a quarter of a cell off, at each border of a stripe.
    stripe_in_cells = K[0, 0] / FAR / block
    assert (carried == labels[1])[seen].mean() > 1 - 1.4 * 0.25 / stripe_in_cells
    follow = intra_window_edges(labels, first_rows(labels), 0.3, window, block)
    by_masks = edges_by_masks(carried, labels[1], 0.3)
    table = as_table(follow, 1, 0, int(first_rows(labels)[1]))
    assert table == pytest.approx(by_masks)


def test_a_wall_behind_a_board_gets_no_label_where_the_other_frame_sees_the_board() -> None:
    aside = np.eye(4)
    aside[0, 3] = 1.5
    window, labels = window_of([np.eye(4), aside])
    carried = carry(window, labels, 1)
    x_of_wall = board_seen_from(aside)[2][..., 0]
    is_wall = labels[1] > 1
    rows = np.abs(np.arange(SIZE[0]) - 19.5)[:, None] < 8
    shadow = np.abs(x_of_wall) < FAR / NEAR * 0.95  # as frame 0 sees the wall: behind the board
    hidden = is_wall & shadow & rows
    assert hidden.sum() > 50
    assert (carried[hidden] == 0).all()
    open_wall = is_wall & (np.abs(x_of_wall) > FAR / NEAR * 1.1) & (np.abs(x_of_wall) < 5)
    assert (carried[open_wall] > 1).all()


def test_what_lies_outside_of_the_other_image_gets_no_label() -> None:
    """The wall moves by whole pixels: not one column of the border is repeated."""
    for shift in (-3, 3, -1):
        aside = np.eye(4)
        aside[0, 3] = shift * FAR / K[0, 0]
        wall = np.full(SIZE, FAR, np.float32)
        window = replace(window_of([np.eye(4), aside])[0], depth=np.stack([wall, wall]))
        labels = np.ones((2, *SIZE), np.uint16)
        carried = carry(window, labels, 1)
        expected = np.zeros(SIZE)
        columns = slice(None, -shift) if shift > 0 else slice(-shift, None)
        expected[:, columns] = 1
        assert np.array_equal(carried, expected)


def test_unknown_depth_carries_no_label() -> None:
    window, labels = window_of([np.eye(4), np.eye(4)])
    window.depth[1, :10] = np.nan
    window.depth[0, 10:20] = np.nan
    carried = carry(window, labels, 1)
    assert (carried[:20] == 0).all()
    assert np.array_equal(carried[20:], labels[0, 20:])


def test_following_links_what_moves_by_its_own_width() -> None:
    aside = np.eye(4)
    aside[0, 3] = 1.0  # a board of 2.0 by half its width, and stripes of 1.0 by all of theirs
    window, labels = window_of([np.eye(4), aside])
    starts = first_rows(labels)
    still = as_table(intra_window_edges(labels, starts, 0.5, None, 1), 1, 0, int(starts[1]))
    followed = as_table(intra_window_edges(labels, starts, 0.5, window, 1), 1, 0, int(starts[1]))
    assert (1, 1) in followed
    assert len(followed) > 5
    assert all(m == n for m, n in followed)
    assert (1, 1) not in still


# --- Algorithm 1 --------------------------------------------------------------------------------


def algorithm_1(inter: Edges, scales: Array, intra: Edges, starts: Indices) -> tuple[Array, Array]:
    """Propagate as the paper prints it: loops over edges and frames."""
    num = int(starts[-1])
    A, W = [0.0] * num, [0.0] * num
    for parent_scale, n, w in zip(scales, inter.child, inter.iou, strict=True):
        A[n] = A[n] + w * parent_scale
        W[n] = W[n] + w
    frame_of = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    for t in range(1, len(starts) - 1):
        for m, n, w in zip(intra.parent, intra.child, intra.iou, strict=True):
            if frame_of[m] == t - 1 and frame_of[n] == t and W[m] > 0:
                mu = A[m] / W[m]
                A[n] = A[n] + w * mu
                W[n] = W[n] + w
    s = [A[n] / W[n] if W[n] > 0 else 1.0 for n in range(num)]
    return np.array(s), np.array(W)


def random_graph(seed: int) -> tuple[Edges, Edges, Indices]:
    """Layers of 6 frames, the first 3 shared; a third of all possible edges."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(rng.integers(0, 7, 6))])

    def edges(pairs: list[tuple[int, int, int]]) -> Edges:
        kept = [pair for pair in pairs if rng.random() < 0.3]
        parent, child, frame = np.array(kept, np.int64).reshape(-1, 3).T
        return Edges(parent, child, rng.uniform(0.05, 1, len(parent)), frame)

    layers = [range(*starts[i : i + 2]) for i in range(6)]
    inter = edges([(m, n, t) for t in range(3) for m in range(5) for n in layers[t]])
    intra = edges([(m, n, t) for t in range(1, 6) for m in layers[t - 1] for n in layers[t]])
    return inter, intra, starts


def test_scales_spread_as_algorithm_1_prints_it() -> None:
    num_both = num_unmatched = 0
    for seed in range(30):
        inter, intra, starts = random_graph(seed)
        measured = np.random.default_rng(seed).lognormal(0, 0.2, len(inter))
        means, weights = propagate(inter, measured, intra, int(starts[-1]))
        expected, expected_weights = algorithm_1(inter, measured, intra, starts)
        np.testing.assert_allclose(weights, expected_weights, rtol=1e-12)
        scales = np.where(weights > 0, means, 1.0)
        np.testing.assert_allclose(scales, expected, rtol=1e-12)
        num_both += len(np.intersect1d(inter.child, intra.child))
        num_unmatched += int((weights == 0).sum())
    assert num_both > 50  # layers of the overlap hear both the window before and the frame before
    assert num_unmatched > 50


def test_what_is_propagated_stays_between_what_was_measured() -> None:
    for seed in range(10):
        inter, intra, starts = random_graph(seed)
        measured = np.random.default_rng(seed).lognormal(0, 0.2, len(inter))
        means, weights = propagate(inter, measured, intra, int(starts[-1]))
        reached = means[weights > 0]
        if len(reached):
            assert measured.min() - 1e-12 <= reached.min()
            assert reached.max() <= measured.max() + 1e-12


def test_several_values_travel_as_each_alone() -> None:
    inter, intra, starts = random_graph(3)
    values = np.random.default_rng(0).normal(size=(len(inter), 2))
    together, _ = propagate(inter, values, intra, int(starts[-1]))
    for k in range(2):
        alone, _ = propagate(inter, values[:, k], intra, int(starts[-1]))
        np.testing.assert_allclose(together[:, k], alone, rtol=1e-12)


def test_without_edges_nothing_arrives() -> None:
    none = np.empty(0, np.int64)
    empty = Edges(none, none, np.empty(0), none)
    means, weights = propagate(empty, np.empty(0), empty, 4)
    assert means.tolist() == weights.tolist() == [0.0] * 4
    assert propagate(empty, np.empty((0, 2)), empty, 4)[0].shape == (4, 2)


# --- tracks -------------------------------------------------------------------------------------


def edges_of(*rows: tuple[int, int, float, int]) -> Edges:
    parent, child, iou, frame = zip(*rows, strict=True)
    return Edges(np.array(parent), np.array(child), np.array(iou), np.array(frame))


def test_a_track_is_a_layer_and_its_best_match_frame_after_frame() -> None:
    inter = edges_of((0, 0, 0.9, 0), (1, 1, 0.9, 0), (2, 2, 0.9, 1), (3, 3, 0.9, 1), (4, 4, 1, 2))
    intra = edges_of((0, 2, 0.8, 1), (1, 3, 0.7, 1), (0, 3, 0.2, 1), (2, 4, 0.9, 2), (4, 5, 0.9, 3))
    track = link_tracks(inter, intra)
    assert track[0] == track[2] == track[4]
    assert track[1] == track[3] != track[0]


def test_layers_that_prefer_others_are_not_of_one_track() -> None:
    """Layer 1 has the child 2 only, but the child has a better parent."""
    inter = edges_of((0, 0, 0.9, 0), (1, 1, 0.9, 0), (2, 2, 0.9, 1))
    track = link_tracks(inter, edges_of((0, 2, 0.6, 1), (1, 2, 0.3, 1)))
    assert track[0] == track[2] != track[1]


def test_two_edges_of_one_child_are_of_one_track() -> None:
    none = np.empty(0, np.int64)
    track = link_tracks(
        edges_of((0, 0, 0.5, 0), (1, 0, 0.4, 0)), Edges(none, none, np.empty(0), none)
    )
    assert track.tolist() == [0, 0]


def pieces_of(log_ratio: list[float], support: list[int] | None = None) -> Pieces:
    num = len(log_ratio)
    return Pieces(
        log_ratio=np.array(log_ratio),
        support=np.array(support or [100] * num),
        depth_bin=np.zeros(num, np.int64),
        log_depth=np.linspace(1, 2, num),
        place=np.tile([0.3, 0.6], (num, 1)),
    )


def test_frames_that_agree_are_joined_by_their_cells() -> None:
    pieces = pieces_of([0.10, 0.11, 0.12], [100, 100, 200])
    joined = join_frames(pieces, np.zeros(3, np.int64), np.ones(3))
    assert joined.log_ratio == pytest.approx([(0.10 + 0.11 + 2 * 0.12) / 4])
    assert joined.log_depth == pytest.approx([(1 + 1.5 + 2 * 2) / 4])
    assert joined.place.tolist() == [[0.3, 0.6]]


@pytest.mark.parametrize("wrong", [-0.6, 0.4])
def test_one_frame_against_the_others_is_left_out(wrong: float) -> None:
    values = [0.10, 0.102, 0.098, 0.101, 0.1 + wrong]
    joined = join_frames(pieces_of(values), np.zeros(5, np.int64), np.ones(5))
    assert joined.log_ratio == pytest.approx([np.mean(values[:4])])


def test_what_only_one_frame_says_is_no_witness_where_others_have_more() -> None:
    pieces, track = pieces_of([0.1, 0.1, 0.3]), np.array([0, 0, 1])
    assert join_frames(pieces, track, np.ones(3)).track.tolist() == [0]


def test_a_single_shared_frame_is_a_witness() -> None:
    joined = join_frames(pieces_of([0.1, 0.3]), np.array([0, 1]), np.ones(2))
    assert joined.track.tolist() == [0, 1]
    assert joined.log_ratio == pytest.approx([0.1, 0.3])


def test_depths_of_one_track_stay_apart() -> None:
    pieces = replace(pieces_of([0.1, 0.1, 0.3, 0.3]), depth_bin=np.array([4, 4, 7, 7]))
    joined = join_frames(pieces, np.zeros(4, np.int64), np.ones(4))
    assert joined.track.tolist() == [0, 0]
    assert joined.log_ratio == pytest.approx([0.1, 0.3])


def test_each_piece_asks_for_its_share() -> None:
    joined = join_frames(pieces_of([0.2, 0.2]), np.zeros(2, np.int64), np.full(2, 0.25))
    assert joined.log_ratio == pytest.approx([0.05])


def test_the_scatter_of_the_frames_is_the_noise() -> None:
    """Within a third over seeds: few frames tell their noise badly, many tracks well."""
    rng = np.random.default_rng(0)
    track = np.repeat(np.arange(200), 5)
    for sigma in (0.01, 0.05):
        pieces = pieces_of(rng.normal(0, sigma, 1000).tolist(), [10**9] * 1000)
        joined = join_frames(pieces, track, np.ones(1000))
        assert np.sqrt(5 * np.median(joined.variance)) == pytest.approx(sigma, rel=0.34)


def test_few_cells_are_less_certain() -> None:
    pieces, track = pieces_of([0.1] * 4, [5, 5, 500, 500]), np.array([0, 0, 1, 1])
    few, many = join_frames(pieces, track, np.ones(4)).variance
    assert few > 5 * many


def test_no_pieces_are_no_observations() -> None:
    none = np.empty(0, np.int64)
    pieces = Pieces(np.empty(0), none, none, np.empty(0), np.empty((0, 2)))
    assert len(join_frames(pieces, none, np.empty(0)).log_ratio) == 0
