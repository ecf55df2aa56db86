"""Depth edges: where a depth map blends what is before with what is behind."""

from __future__ import annotations

from typing import Any

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def drop_edges(depth: Any, max_jump: float, weight: Any) -> None:
    """Set the weight of both pixels to 0 wherever depth jumps between neighbours.

    A step of more than ``max_jump`` of the nearer depth is a jump, unless the pixels before and
    after continue it as a plane would (inverse depth is linear on a plane): a road seen at a
    grazing angle stays. A step of three times as much is always a jump.
    """
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            if u + 1 < width and _jumps(depth, v, u, (0, 1), max_jump):
                weight[v, u] = weight[v, u + 1] = 0.0
            if v + 1 < height and _jumps(depth, v, u, (1, 0), max_jump):
                weight[v, u] = weight[v + 1, u] = 0.0


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _jumps(depth: Any, v: int, u: int, step: Any, max_jump: float) -> bool:
    here, there = depth[v, u], depth[v + step[0], u + step[1]]
    jump = abs(here - there) / min(here, there)
    if not jump > max_jump:  # also where depth is unknown
        return False
    if jump > 3 * max_jump:
        return True
    v_before, u_before = v - step[0], u - step[1]
    v_after, u_after = v + 2 * step[0], u + 2 * step[1]
    if v_before < 0 or u_before < 0 or v_after >= depth.shape[0] or u_after >= depth.shape[1]:
        return True
    slope = 1 / there - 1 / here
    bend_before = slope - (1 / here - 1 / depth[v_before, u_before])
    bend_after = (1 / depth[v_after, u_after] - 1 / there) - slope
    # not <=: unknown neighbours prove no plane
    return not max(abs(bend_before), abs(bend_after)) <= 0.3 * abs(slope)
