"""True revisits along a drive, and wrong closures between places that have nothing in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from laser_slam.evaluation.trajectory import path_distances
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.slam import Node
from laser_slam.types import Trajectory

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

FAR_M = 50.0  # between places that have nothing in common
WRONG_LOG_SCALE, WRONG_TURN_DEG, WRONG_MOVE = 0.3, 5.0, 0.5  # of inventions; moves in window units


@dataclass(frozen=True)
class RevisitRule:
    """Which pairs of frames see one place.

    Attributes:
        near_m: metres between the cameras, at most.
        angle_deg: degrees between their optical axes, at most.
        gap_m: metres travelled between the visits, at least.
        apart_m: metres travelled from one pair of a stretch to the next, at least.
    """

    near_m: float = 4.0
    angle_deg: float = 30.0
    gap_m: float = 100.0
    apart_m: float = 25.0


@dataclass(frozen=True)
class LoopClosure:
    """A closure as the pose graph gets it.

    Attributes:
        a: index of the earlier window.
        b: index of the later one.
        a_from_b: measured, or invented.
        sigmas: (7,) as in ``Registration.sigmas``, a being the previous window.
        is_right: the windows saw one place, and this was measured.
    """

    a: int
    b: int
    a_from_b: Sim3
    sigmas: Array
    is_right: bool


def find_revisits(truth: Trajectory, rule: RevisitRule) -> Ids:
    """Return (M, 2) frame indices, older and newer, a few pairs per stretch; the nearest ones."""
    poses = truth.world_from_cam
    travelled = path_distances(truth)
    pairs = cKDTree(poses[:, :3, 3]).query_pairs(rule.near_m, output_type="ndarray")
    older, newer = np.sort(pairs, axis=1).T
    cosines = np.einsum("ni,ni->n", poses[older, :3, 2], poses[newer, :3, 2])
    gap = travelled[newer] - travelled[older]
    fits = (gap >= rule.gap_m) & (cosines >= np.cos(np.radians(rule.angle_deg)))
    older, newer = older[fits], newer[fits]
    order = np.argsort(np.linalg.norm(poses[older, :3, 3] - poses[newer, :3, 3], axis=1))
    kept: list[int] = []
    for row in order.tolist():
        before = np.abs(travelled[older[kept]] - travelled[older[row]]) < rule.apart_m
        after = np.abs(travelled[newer[kept]] - travelled[newer[row]]) < rule.apart_m
        if not (before & after).any():
            kept.append(row)
    kept.sort(key=lambda row: (newer[row], older[row]))
    return np.asarray(np.stack([truth.frames[older[kept]], truth.frames[newer[kept]]], axis=1))


def invent_closures(
    num: int,
    nodes: Sequence[Node],
    truth: Trajectory,
    measured: Sequence[LoopClosure],
    group: int = 1,
) -> list[LoopClosure]:
    """Close windows that saw different places, as sure of it as measurements are.

    Each has the similarity and the sigmas of another pair's right closure; where there is none,
    a similarity near the identity and the sigmas of a registration.

    Args:
        num: how many.
        nodes: of the chain.
        truth: of the drive, metres.
        measured: right closures.
        group: so many in a row agree with one another, as where two streets look alike.
    """
    rng = np.random.default_rng([len(nodes), num, group])
    rows = np.searchsorted(truth.frames, [node.frames[len(node.frames) // 2] for node in nodes])
    gap = truth.world_from_cam[rows][:, None, :3, 3] - truth.world_from_cam[rows][None, :, :3, 3]
    strangers = np.argwhere(np.triu(np.linalg.norm(gap, axis=2) > FAR_M))
    if not len(strangers):
        return []
    out: list[LoopClosure] = []
    while len(out) < num:
        a, b = (int(index) for index in strangers[rng.integers(len(strangers))])
        closure = LoopClosure(a, b, *_borrow(nodes, measured, rng), is_right=False)
        for _ in range(min(group, num - len(out))):
            out.append(closure)
            if closure.b + 1 == len(nodes):
                break
            closure = _next(closure, nodes)
    return out


def _borrow(
    nodes: Sequence[Node], measured: Sequence[LoopClosure], rng: np.random.Generator
) -> tuple[Sim3, Array]:
    if measured:
        other = measured[int(rng.integers(len(measured)))]
        return other.a_from_b, other.sigmas
    links = [node.registration for node in nodes if node.registration is not None]
    turn = np.radians(WRONG_TURN_DEG) * rng.standard_normal(3)
    scale = float(np.exp(WRONG_LOG_SCALE * rng.standard_normal()))
    wrong = Sim3(scale, np.asarray(rotation_exp(turn)), WRONG_MOVE * rng.standard_normal(3))
    return wrong, np.median([link.sigmas for link in links], axis=0)


def _next(closure: LoopClosure, nodes: Sequence[Node]) -> LoopClosure:
    """Return what the same confusion says of the windows after."""
    a, b = closure.a + 1, closure.b + 1
    a_from_next, b_from_next = (_from_previous(nodes[index]) for index in (a, b))
    a_from_b = a_from_next.inverse() @ closure.a_from_b @ b_from_next
    return LoopClosure(a, b, a_from_b, closure.sigmas, is_right=False)


def _from_previous(node: Node) -> Sim3:
    if node.registration is None:
        raise ValueError("the first window has none before it")
    return node.registration.previous_from_current
