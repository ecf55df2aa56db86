"""The layer graph: which layers show the same surface, across windows and from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from laser_slam.layers.alignment_kernels import carry_labels, count_pairs
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
    found = []
    for i in range(1, len(labels)):
        before = labels[i - 1] if window is None else _carried(labels[i - 1], window, i, block)
        found.append(_edges((before, starts[i - 1]), (labels[i], starts[i]), tau, i))
    return _joined(found)


def _carried(before: Labels, window: Prediction, frame: int, block: int) -> Labels:
    """Return the labels of the frame before as this frame's cells see them."""
    K = window.intrinsics
    before_from_here = (
        np.linalg.inv(window.window_from_cam[frame - 1]) @ window.window_from_cam[frame]
    )
    pixel_there_from_here = K[frame - 1] @ before_from_here[:3]
    pixel_there_from_here[:, :3] = pixel_there_from_here[:, :3] @ np.linalg.inv(K[frame])
    there, here = (window.depth[i, ::block, ::block] for i in (frame - 1, frame))
    out: Labels = carry_labels(before, there, here, pixel_there_from_here, block)
    return out


def _edges(
    parents: tuple[Labels, int], children: tuple[Labels, int], tau: float, frame: int
) -> Edges:
    (labels_a, first_a), (labels_b, first_b) = parents, children
    # Whatever is unknown in either image says nothing of the overlap of two layers.
    shared = count_pairs(labels_a, labels_b, int(labels_a.max()), int(labels_b.max()))[1:, 1:]
    union = shared.sum(axis=1)[:, None] + shared.sum(axis=0)[None] - shared
    iou = shared / np.maximum(union, 1)
    m, n = np.nonzero(iou > tau)
    return Edges(m + first_a, n + first_b, iou[m, n], np.full(len(m), frame))


def _joined(parts: list[Edges]) -> Edges:
    none = np.empty(0, np.int64)
    parent, child, frame = (
        np.concatenate([none, *(getattr(part, name) for part in parts)])
        for name in ("parent", "child", "frame")
    )
    return Edges(parent, child, np.concatenate([np.empty(0), *(p.iou for p in parts)]), frame)
