"""Compiled parts of the plane sweep: census, cost volume, semi-global matching, winners."""

from __future__ import annotations

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from laser_slam.backbones.classical.compiled import finite_kernel

STEP_PENALTY = np.float32(3.0)  # Hamming bits for a step of one plane
JUMP_PENALTY, JUMP_FLOOR = (
    np.float32(60.0),
    np.float32(9.0),
)  # for a larger one; less at image edges
EDGE_WEIGHT = np.float32(0.12)  # per grey value, how fast an image edge cheapens a jump
NO_VIEW_COST = 12.0  # of a pixel that no neighbour sees: half of the census bits


@njit(cache=True, nogil=True)
def census_transform(grey):
    """Return (H, W) uint32: a bit for each of 24 neighbours that is darker than the centre."""
    height, width = grey.shape
    out = np.zeros((height, width), np.uint32)
    for i in range(2, height - 2):
        for j in range(2, width - 2):
            centre, bits = grey[i, j], np.uint32(0)
            for di in range(-2, 3):
                for dj in range(-2, 3):
                    if di != 0 or dj != 0:
                        bits = (bits << np.uint32(1)) | np.uint32(grey[i + di, j + dj] < centre)
            out[i, j] = bits
    return out


@intrinsic
def _count_bits(_, value):
    """Count the set bits of a uint32 by the processor's own instruction."""

    def generate(_context, builder, _signature, arguments):
        return builder.ctpop(arguments[0])

    return types.uint32(types.uint32), generate


@finite_kernel
def _side_costs(census, i, j, others, maps, planes, sums, counts):
    """Add to (D,) sums and counts the Hamming distances of one pixel in the views of one side."""
    height, width = others.shape[1], others.shape[2]
    value = census[i, j]
    for n in range(maps.shape[0]):
        m = maps[n]
        a = np.float32(m[0, 0] * j + m[0, 1] * i + m[0, 2])
        b = np.float32(m[1, 0] * j + m[1, 1] * i + m[1, 2])
        c = np.float32(m[2, 0] * j + m[2, 1] * i + m[2, 2])
        ta, tb, tc = np.float32(m[0, 3]), np.float32(m[1, 3]), np.float32(m[2, 3])
        for d in range(planes.shape[0]):
            z = c + tc * planes[d]
            if z <= np.float32(1e-6):
                continue
            inv = np.float32(1.0) / z
            x = (a + ta * planes[d]) * inv + np.float32(0.5)
            y = (b + tb * planes[d]) * inv + np.float32(0.5)
            if x < 2 or y < 2 or x >= width - 2 or y >= height - 2:
                continue
            sums[d] += np.float32(_count_bits(value ^ others[n, int(y), int(x)]))
            counts[d] += np.float32(1.0)


@njit(cache=True, nogil=True)
def fill_volume(census, past, future, past_maps, future_maps, planes, volume):
    """Fill (H, W, D) costs in quarter bits: the better side counts three times the other."""
    num = planes.shape[0]
    past_sum, past_num = np.zeros(num, np.float32), np.zeros(num, np.float32)
    future_sum, future_num = np.zeros(num, np.float32), np.zeros(num, np.float32)
    for i in range(volume.shape[0]):
        for j in range(volume.shape[1]):
            past_sum[:] = 0
            past_num[:] = 0
            future_sum[:] = 0
            future_num[:] = 0
            _side_costs(census, i, j, past, past_maps, planes, past_sum, past_num)
            _side_costs(census, i, j, future, future_maps, planes, future_sum, future_num)
            for d in range(num):
                p = past_sum[d] / past_num[d] if past_num[d] > 0 else np.float32(-1)
                f = future_sum[d] / future_num[d] if future_num[d] > 0 else np.float32(-1)
                if p < 0 and f < 0:
                    cost = np.float32(NO_VIEW_COST)
                elif p < 0 or f < 0:
                    cost = max(p, f)
                else:
                    cost = np.float32(0.75) * min(p, f) + np.float32(0.25) * max(p, f)
                volume[i, j, d] = np.uint8(np.float32(4.0) * cost)


@finite_kernel
def _path_step(volume, previous, jump, current, total):
    """Extend one path by a pixel: (D,) costs so far to (D,) costs with this pixel."""
    num = previous.shape[0]
    lowest = previous.min()
    for d in range(num):
        best = min(previous[d], lowest + jump)
        if d > 0:
            best = min(best, previous[d - 1] + STEP_PENALTY)
        if d < num - 1:
            best = min(best, previous[d + 1] + STEP_PENALTY)
        current[d] = np.float32(0.25) * np.float32(volume[d]) + best - lowest
        total[d] += current[d]


@finite_kernel
def _jump(grey, i, j, k, m):
    contrast = np.float32(abs(np.int64(grey[i, j]) - np.int64(grey[k, m])))
    return max(JUMP_FLOOR, JUMP_PENALTY / (np.float32(1.0) + EDGE_WEIGHT * contrast))


@njit(cache=True, nogil=True)
def aggregate_paths(volume, grey, total):
    """Add the costs of the four straight paths to (H, W, D) ``total``."""
    height, width, num = volume.shape
    a, b = np.zeros(num, np.float32), np.zeros(num, np.float32)
    for i in range(height):
        for direction in (1, -1):
            a[:] = 0
            first = 0 if direction == 1 else width - 1
            for n in range(width):
                j = first + direction * n
                jump = _jump(grey, i, j, i, j - direction) if n else JUMP_FLOOR
                _path_step(volume[i, j], a, jump, b, total[i, j])
                a, b = b, a
    rows, other = np.zeros((width, num), np.float32), np.zeros((width, num), np.float32)
    for direction in (1, -1):
        rows[:] = 0
        first = 0 if direction == 1 else height - 1
        for n in range(height):
            i = first + direction * n
            for j in range(width):
                jump = _jump(grey, i, j, i - direction, j) if n else JUMP_FLOOR
                _path_step(volume[i, j], rows[j], jump, other[j], total[i, j])
            rows, other = other, rows


@njit(cache=True, nogil=True)
def choose_winners(total, volume, planes):
    """Return inverse depth (parabola between planes), uniqueness, cost, and far-plane mask."""
    height, width, num = total.shape
    inverse_depth = np.zeros((height, width), np.float32)
    uniqueness, cost = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    is_far = np.zeros((height, width), np.bool_)
    step = planes[1] - planes[0]
    for i in range(height):
        for j in range(width):
            costs = total[i, j]
            best = np.argmin(costs)
            second = np.float32(1e9)
            for d in range(best - 2):
                second = min(second, costs[d])
            for d in range(best + 3, num):
                second = min(second, costs[d])
            offset = 0.0
            if 0 < best < num - 1:
                left, right = costs[best - 1] - costs[best], costs[best + 1] - costs[best]
                if left + right > 0:
                    offset = 0.5 * (left - right) / (left + right)
            inverse_depth[i, j] = planes[best] + step * offset
            uniqueness[i, j] = second - costs[best]
            cost[i, j] = 0.25 * volume[i, j, best]
            is_far[i, j] = best >= num - 2
    return inverse_depth, uniqueness, cost, is_far


@njit(cache=True, nogil=True)
def raise_motion(mapping, inverse_depth, out):
    """Raise (H, W) ``out`` to the pixels that a unit of inverse depth moves in this neighbour."""
    height, width = inverse_depth.shape
    for i in range(height):
        for j in range(width):
            w = inverse_depth[i, j]
            x = mapping[0, 0] * j + mapping[0, 1] * i + mapping[0, 2] + mapping[0, 3] * w
            y = mapping[1, 0] * j + mapping[1, 1] * i + mapping[1, 2] + mapping[1, 3] * w
            z = mapping[2, 0] * j + mapping[2, 1] * i + mapping[2, 2] + mapping[2, 3] * w
            if z <= 1e-6:
                continue
            du = (mapping[0, 3] * z - mapping[2, 3] * x) / (z * z)
            dv = (mapping[1, 3] * z - mapping[2, 3] * y) / (z * z)
            out[i, j] = max(out[i, j], np.sqrt(du * du + dv * dv))
