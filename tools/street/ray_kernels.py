"""Compiled ray casting of the street's boxes and poles."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def cast_boxes(boxes, box_ids, columns, origin, rays, depth, ids):
    for k in range(len(boxes)):
        x0, y0, z0 = boxes[k, 0] - origin[0], boxes[k, 1] - origin[1], boxes[k, 2] - origin[2]
        x1, y1, z1 = boxes[k, 3] - origin[0], boxes[k, 4] - origin[1], boxes[k, 5] - origin[2]
        for row in range(depth.shape[0]):
            for col in range(columns[k, 0], columns[k, 1]):
                rx, ry, rz = rays[row, col, 0], rays[row, col, 1], rays[row, col, 2]
                a, b = x0 / rx, x1 / rx
                near, far = min(a, b), max(a, b)
                a, b = y0 / ry, y1 / ry
                near, far = max(near, min(a, b)), min(far, max(a, b))
                a, b = z0 / rz, z1 / rz
                near, far = max(near, min(a, b)), min(far, max(a, b))
                if 0.0 < near < far and near < depth[row, col]:
                    depth[row, col], ids[row, col] = near, box_ids[k]


@njit(cache=True, nogil=True, error_model="numpy")
def cast_poles(poles, pole_ids, columns, origin, rays, depth, ids):
    for k in range(len(poles)):
        dx, dz = origin[0] - poles[k, 0], origin[2] - poles[k, 1]
        for row in range(depth.shape[0]):
            for col in range(columns[k, 0], columns[k, 1]):
                rx, ry, rz = rays[row, col, 0], rays[row, col, 1], rays[row, col, 2]
                a, b = rx * rx + rz * rz, dx * rx + dz * rz
                root = b * b - a * (dx * dx + dz * dz - poles[k, 2] ** 2)
                if root <= 0.0:
                    continue
                z = (-b - np.sqrt(root)) / a
                if 0.0 < z < depth[row, col] and origin[1] + z * ry > poles[k, 3]:
                    depth[row, col], ids[row, col] = z, pole_ids[k]
