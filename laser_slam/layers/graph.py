"""The layer graph: which layers show the same surface, across windows and from frame to frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.layers.alignment_kernels import carry_labels, count_pairs, overlaps
from laser_slam.types import Prediction

Indices = NDArray[np.int64]
Labels = NDArray[np.uint16]


@dataclass(frozen=True)
class Edges:
    """Directed edges between layers, each from a parent to a child.

    Attributes:
        parent: (E,) row of the parent; of the window before or of the same one.
        child: (E,) row of the child.
        iou: (E,) intersection over union of the two, as pixels of one image.
        frame: (E,) which frame of the current window the child is in.
    """

    parent: Indices
    child: Indices
    iou: NDArray[np.float64]
    frame: Indices

    def __len__(self) -> int:
        return len(self.parent)

    def chosen(self, mask: NDArray[np.bool_]) -> Edges:
        """Return some of the edges."""
        return Edges(self.parent[mask], self.child[mask], self.iou[mask], self.frame[mask])


def first_rows(labels: Labels) -> Indices:
    """Return (N + 1,) where the layers of each frame begin when all are counted."""
    return np.concatenate([[0], np.cumsum(labels.max(axis=(1, 2), initial=0))]).astype(np.int64)


def inter_window_edges(
    parents: tuple[Labels, Indices, Indices], children: tuple[Labels, Indices, Indices], tau: float
) -> Edges:
    """Link the layers that two windows see in the frames they share.

    Args:
        parents: labels (N, h, w) of the window before, ``starts`` (N + 1,) of its rows, and
            (K,) where the shared frames are in it.
        children: the same of the current window.
        tau: IoU that an edge must exceed.
    """
    (labels_a, starts_a, in_a), (labels_b, starts_b, in_b) = parents, children
    found = [
        _edges((labels_a[i], starts_a[i]), (labels_b[j], starts_b[j]), tau, int(j))
        for i, j in zip(in_a, in_b, strict=True)
    ]
    return _joined(found)


def intra_window_edges(
    labels: Labels, starts: Indices, tau: float, window: Prediction | None, block: int
) -> Edges:
    """Link the layers of consecutive frames of one window.

    Args:
        labels: (N, h, w).
        starts: (N + 1,) of the rows.
        tau: IoU that an edge must exceed.
        window: carries each layer to where the next frame sees it, by its depth and poses; None:
            the same pixels are compared, as if the camera stood still.
        block: pixels that a label's cell has a side.
    """
    carried = labels[:-1] if window is None else _carried(labels, window, block)
    found = [
        _edges((before, starts[i]), (labels[i + 1], starts[i + 1]), tau, i + 1)
        for i, before in enumerate(carried)
    ]
    return _joined(found)


def _carried(labels: Labels, window: Prediction, block: int) -> Iterator[Labels]:
    """Yield the labels of each frame but the last as the cells of the next frame see them."""
    K, window_from_cam = window.intrinsics, window.window_from_cam
    before_from_here = np.linalg.inv(window_from_cam[:-1]) @ window_from_cam[1:]
    pixel_there_from_here = K[:-1] @ before_from_here[:, :3]
    pixel_there_from_here[..., :3] = pixel_there_from_here[..., :3] @ np.linalg.inv(K[1:])
    depth = window.depth[:, ::block, ::block]
    for i, M in enumerate(pixel_there_from_here):
        yield carry_labels(labels[i], depth[i], depth[i + 1], M, block)


def _edges(
    parents: tuple[Labels, int], children: tuple[Labels, int], tau: float, frame: int
) -> Edges:
    (labels_a, first_a), (labels_b, first_b) = parents, children
    # Whatever is unknown in either image says nothing of the overlap of two layers.
    shared = count_pairs(labels_a, labels_b, int(labels_a.max()), int(labels_b.max()))
    m, n, iou = overlaps(shared, tau)
    return Edges(m + first_a, n + first_b, iou, np.full(len(m), frame))


def _joined(parts: list[Edges]) -> Edges:
    none = np.empty(0, np.int64)
    parent, child, frame = (
        np.concatenate([none, *(getattr(part, name) for part in parts)])
        for name in ("parent", "child", "frame")
    )
    return Edges(parent, child, np.concatenate([np.empty(0), *(p.iou for p in parts)]), frame)
