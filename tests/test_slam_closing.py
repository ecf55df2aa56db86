"""Closing loops: windows and frames go where chain and closures agree, the map goes with them."""

import numpy as np
import pytest
from ring import (
    LAP,
    NO_DRIFT,
    NUM_FRAMES,
    NUM_WINDOWS,
    TIMES_S,
    Array,
    Drift,
    ate_m,
    black,
    chain,
    frames_of,
    prediction_of,
    ring_pose,
    true_link,
    unit_of,
)
from scipy.spatial import KDTree

from laser_slam.config import FusionConfig
from laser_slam.errors import DegenerateGeometryError
from laser_slam.fusion import fuse
from laser_slam.sim3 import Sim3, rotation_log, umeyama
from laser_slam.slam import Node, Slam
from laser_slam.types import Cloud, WindowStatus

SEEDS = range(6)
LOOPS = [(1, 19), (3, 21), (4, 22)]  # windows that see one place; a lap is 18 of them


def close_all(slam: Slam, seed: int, loops: list[tuple[int, int]] = LOOPS) -> list[bool]:
    return [slam.close(a, b, *true_link(a, b, seed)) for a, b in loops]


def trusted(slam: Slam) -> list[bool]:
    assert slam.optimised is not None
    return [bool(is_trusted) for is_trusted in slam.optimised.is_trusted]


def poses(slam: Slam) -> Array:
    return slam.trajectory(TIMES_S).world_from_cam


def places(slam: Slam) -> Array:
    return np.array([node.world_from_window.matrix() for node in slam.nodes])


def size(slam: Slam) -> float:
    """Return the path's size in world units."""
    return float(np.linalg.norm(np.ptp(poses(slam)[:, :3, 3], axis=0)))


# Where windows go


def test_closures_take_most_of_the_drift_away() -> None:
    before, after = [], []
    for seed in SEEDS:
        slam = chain(Drift(seed=seed))
        before.append(ate_m(slam.trajectory(TIMES_S)))
        close_all(slam, seed)
        assert trusted(slam) == [True] * len(LOOPS)
        after.append(ate_m(slam.trajectory(TIMES_S)))
        assert after[-1] < 0.6 * before[-1]
    assert np.mean(after) < 0.3 * np.mean(before)


def test_a_true_closure_of_a_true_chain_moves_nothing() -> None:
    slam = chain(NO_DRIFT)
    before = poses(slam)
    assert all(close_all(slam, 0))
    assert np.allclose(poses(slam), before, atol=1e-4 * size(slam))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_wrong_closure_is_distrusted_and_does_not_bend_the_map(seed: int) -> None:
    """Windows half a lap apart are said to be one place."""
    slam = chain(Drift(seed=seed))
    close_all(slam, seed)
    before = poses(slam)
    _, sigmas = true_link(5, 14, seed)
    here = Sim3(unit_of(14, seed) / unit_of(5, seed))
    assert not slam.close(5, 14, here, sigmas)
    assert trusted(slam) == [True, True, True, False]
    assert slam.optimised is not None
    assert slam.optimised.misfits[-1] > 10
    assert np.allclose(poses(slam), before, atol=1e-3 * size(slam))


def test_a_closure_that_is_too_good_for_the_chain_is_trusted_once_another_agrees() -> None:
    slam = chain(Drift(seed=0))
    before = poses(slam)
    assert not slam.close(1, 19, *true_link(1, 19, 0))
    assert np.allclose(poses(slam), before, atol=1e-6 * size(slam))
    assert slam.close(3, 21, *true_link(3, 21, 0))
    assert trusted(slam) == [True, True]


def test_a_wrong_closure_alone_leaves_the_chain_as_it_was() -> None:
    slam = chain(Drift())
    before = poses(slam)
    _, sigmas = true_link(5, 14)
    assert not slam.close(5, 14, Sim3(unit_of(14) / unit_of(5)), sigmas)
    assert np.allclose(poses(slam), before, atol=1e-6 * size(slam))


def test_the_first_camera_stays_the_world() -> None:
    slam = chain(Drift(seed=1))
    first = slam.nodes[0].world_from_window
    close_all(slam, 1)
    assert np.allclose(slam.nodes[0].world_from_window.matrix(), first.matrix(), atol=1e-5)


def test_closures_come_as_the_drive_goes_on_and_the_chain_goes_on_from_there() -> None:
    seed = 1
    drift = Drift(seed=seed)
    slam = chain(drift, 20)
    assert slam.close(1, 19, *true_link(1, 19, seed))
    moved = slam.nodes[-1]
    assert not np.allclose(moved.world_from_window.matrix(), moved.chained.matrix(), atol=1e-2)
    slam.add(prediction_of(20, drift), black())
    added = slam.nodes[-1]
    assert added.registration is not None
    link = added.registration.previous_from_current
    expected = moved.world_from_window @ link
    assert np.allclose(added.world_from_window.matrix(), expected.matrix(), rtol=1e-9)
    assert np.allclose(added.chained.matrix(), (moved.chained @ link).matrix(), rtol=1e-9)


def test_closures_on_the_way_lead_to_where_closures_at_the_end_do() -> None:
    seed = 2
    drift = Drift(seed=seed)
    late = chain(drift)
    close_all(late, seed)
    early = chain(drift, 0)
    for window in range(NUM_WINDOWS):
        early.add(prediction_of(window, drift), black())
        close_all(early, seed, [pair for pair in LOOPS if pair[1] == window])
    assert trusted(early) == trusted(late) == [True] * len(LOOPS)
    assert np.allclose(poses(early), poses(late), atol=2e-3 * size(late))
    chained = [[node.chained.matrix() for node in slam.nodes] for slam in (early, late)]
    assert np.allclose(*chained, rtol=1e-9, atol=1e-9)


def test_a_window_that_nobody_knows_is_refused_and_nothing_moves() -> None:
    for num in (0, 1, 3):
        slam = chain(NO_DRIFT, num)
        before = places(slam)
        with pytest.raises(DegenerateGeometryError, match="not in the pose graph"):
            slam.close(0, 7, *true_link(0, 7))
        assert np.array_equal(places(slam), before)
        assert slam.optimised is None


def test_a_drive_goes_on_after_a_closure_that_was_refused() -> None:
    slam = chain(Drift(seed=1))
    link, sigmas = true_link(1, 19, 1)
    with pytest.raises(DegenerateGeometryError, match="sigma"):
        slam.close(1, 19, link, sigmas * np.nan)
    assert all(close_all(slam, 1))
    assert trusted(slam) == [True] * len(LOOPS)


def stretch(node: Node, before: Node) -> float:
    """Return how far closures have moved a window against the one before, as a turn in radians."""
    assert node.registration is not None
    link = before.world_from_window.inverse() @ node.world_from_window
    change = node.registration.previous_from_current.inverse() @ link
    return float(np.linalg.norm(rotation_log(change.rotation)))


def test_bridged_windows_give_way_before_measured_ones() -> None:
    """Window 9 is blind while the camera drives on: the loop is open by what it missed."""
    slam = chain(Drift(seed=1), statuses={9: WindowStatus.STATIC})
    assert list(slam.bridged) == [9, 10]
    before = ate_m(slam.trajectory(TIMES_S))
    assert all(close_all(slam, 1))
    turns = np.array([stretch(b, a) for a, b in zip(slam.nodes, slam.nodes[1:], strict=False)])
    guessed = [8, 9]  # from windows 8 to 9, and 9 to 10
    assert turns[guessed].min() > 5 * np.delete(turns, guessed).max()
    assert ate_m(slam.trajectory(TIMES_S)) < 0.5 * before


# Where frames go


def jumps(slam: Slam) -> tuple[Array, Array]:
    """Return how far frames lie from where they were if moved as the frame before them.

    In world units: inside windows, and where windows meet.
    """
    before = slam.trajectory(TIMES_S, closed=False).world_from_cam[:, :3, 3]
    moves = [
        place @ node.chained.inverse()
        for node, of_frames in zip(slam.nodes, slam.frame_places(), strict=True)
        for place in of_frames
    ]
    apart = np.array(
        [
            np.linalg.norm(moves[i].apply(before[i]) - moves[i - 1].apply(before[i]))
            for i in range(1, len(moves))
        ]
    )
    borders = np.array([node.owned[0] for node in slam.nodes[1:]]) - 1
    return np.delete(apart, borders), apart[borders]


@pytest.mark.parametrize("seed", SEEDS)
def test_no_frame_jumps_where_windows_meet(seed: int) -> None:
    slam = chain(Drift(seed=seed))
    close_all(slam, seed)
    inside, borders = jumps(slam)
    assert borders.max() < 1.5 * inside.max()
    assert inside.max() > 1e-4 * size(slam)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_map_takes_each_frame_where_the_trajectory_has_it(seed: int) -> None:
    slam = chain(Drift(seed=seed))
    close_all(slam, seed)
    trajectory = slam.trajectory(TIMES_S)
    assert np.array_equal(trajectory.frames, np.arange(NUM_FRAMES))
    spread = slam.frame_places()
    num = 0
    for node, of_frames in zip(slam.nodes, spread, strict=True):
        submap = node.submap(prediction_of(node.index, Drift(seed=seed)), black(), of_frames)
        for i in np.flatnonzero(submap.is_owned):
            pose = submap.places[i].apply_poses(submap.prediction.window_from_cam[i])
            expected = trajectory.world_from_cam[submap.prediction.frames[i]]
            assert np.allclose(pose, expected, atol=1e-9)
            num += 1
    assert num == NUM_FRAMES


# Where the map's points go


def visits(slam: Slam, drift: Drift) -> tuple[Cloud, Cloud]:
    """Fuse what the first and the second lap saw of the same quarter of the room, in metres."""
    config = FusionConfig(min_observations=1, max_range=1.5, voxel_size=0.02)
    laps = []
    for lap in (0, 1):
        chosen = range(lap * LAP, lap * LAP + LAP // 5)
        laps.append(
            fuse(
                (
                    node.submap(prediction_of(node.index, drift), black(), of_frames)
                    for node, of_frames in zip(slam.nodes, slam.frame_places(), strict=True)
                    if set(frames_of(node.index)) & set(chosen)
                ),
                config,
            )
        )
    return laps[0], laps[1]


def apart_m(slam: Slam, drift: Drift) -> float:
    """Return the median distance of the second visit's points to the first visit's."""
    first, second = visits(slam, drift)
    trajectory = slam.trajectory(TIMES_S)
    truth = np.stack([ring_pose(int(frame))[:3, 3] for frame in trajectory.frames])
    metres = umeyama(trajectory.world_from_cam[:, :3, 3], truth).scale
    distances, _ = KDTree(first.points).query(second.points)
    return float(np.median(distances)) * metres


def test_both_visits_of_a_wall_give_one_wall_after_the_closure_and_two_before() -> None:
    for seed in (0, 1, 2):
        drift = Drift(seed=seed)
        slam = chain(drift)
        before = apart_m(slam, drift)
        close_all(slam, seed)
        after = apart_m(slam, drift)
        assert after < 0.3 * before, (seed, before, after)


def test_a_true_drive_sees_one_wall_twice() -> None:
    """The yardstick of the test above: what the sampling of the walls alone leaves open."""
    assert apart_m(chain(NO_DRIFT), NO_DRIFT) < 1e-3
