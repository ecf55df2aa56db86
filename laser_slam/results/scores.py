"""What the truth says of a run, as far as there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.evaluation.depth import evaluate_depth
from laser_slam.evaluation.trajectory import TrajectoryErrors, evaluate_trajectory
from laser_slam.pose_graph import spread_corrections
from laser_slam.slam import Node, StoredWindow
from laser_slam.types import Image, Trajectory

Labels = NDArray[np.uint16]


Load = Callable[[int], StoredWindow]


@dataclass(frozen=True)
class KeyframeView:
    """What a run says of one keyframe.

    Attributes:
        frame: index in the sequence.
        image: (H, W, 3) RGB.
        depth: (H, W) in world units; NaN: unknown.
        confidence: (H, W) in [0, 1].
        raw_depth: (H, W) the same before the layers' scales were applied.
        labels: (h, w) its layers; None: they were not looked at.
    """

    frame: int
    image: Image
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    raw_depth: NDArray[np.float32]
    labels: Labels | None


@dataclass(frozen=True)
class Scores:
    """What the truth says of a run; None where there is none.

    Attributes:
        trajectory: errors of the frames' poses.
        depth: errors of the keyframes' depth, as in the report.
        raw_depth: the same before the layers' scales were applied; None where there are none.
        views: the keyframes that were looked at.
    """

    trajectory: TrajectoryErrors | None
    depth: dict[str, Any] | None
    raw_depth: dict[str, Any] | None
    views: Sequence[KeyframeView]


def sample_views(nodes: Sequence[Node], load: Load, num: int) -> Iterator[KeyframeView]:
    """Take up to ``num`` keyframes with depth, spread evenly over the run.

    Args:
        nodes: the places of all windows.
        load: reads a window back by its index.
        num: how many.
    """
    placed = zip(nodes, spread_corrections([node.moved for node in nodes]), strict=True)
    owned = [
        (node, int(i), place)
        for node, places in placed
        for i, place in zip(np.flatnonzero(node.is_owned), places, strict=True)
    ]
    chosen = np.unique(np.linspace(0, len(owned) - 1, min(num, len(owned))).round().astype(int))
    index = -1
    for node, i, place in (owned[k] for k in chosen):
        if node.index != index:
            index = node.index
            window = load(index)
        scale = np.float32(place.scale)
        depth = window.corrected.depth[i] * scale
        if np.isfinite(depth).any():
            yield KeyframeView(
                int(node.frames[i]),
                window.colors[i],
                depth,
                window.corrected.confidence[i],
                window.raw.depth[i] * scale,
                None if window.layers is None else window.layers.labels[i],
            )


def score_views(
    views: Sequence[KeyframeView],
    trajectory: Trajectory,
    truth: Trajectory | None,
    true_depth: Callable[[int], NDArray[np.float32] | None],
    min_confidence: float,
) -> Scores:
    """Compare poses, and the depth of keyframes with and without the layers' scales.

    Args:
        views: keyframes of the run.
        trajectory: the poses of all frames.
        truth: poses in metres; None: there is none.
        true_depth: gives a frame's (H, W) truth in metres, or None.
        min_confidence: pixels below it are not compared.
    """
    errors = None if truth is None else evaluate_trajectory(trajectory, truth)
    metres_per_unit = errors.scale if errors else None
    depth = score_depth(views, true_depth, metres_per_unit, min_confidence)
    raw = None
    if any(view.labels is not None for view in views):
        as_predicted = [replace(view, depth=view.raw_depth) for view in views]
        raw = score_depth(as_predicted, true_depth, metres_per_unit, min_confidence)
    return Scores(errors, depth, raw, views)


def score_depth(
    views: Sequence[KeyframeView],
    true_depth: Callable[[int], NDArray[np.float32] | None],
    metres_per_unit: float | None,
    min_confidence: float,
) -> dict[str, Any] | None:
    """Compare the confident depth of keyframes with the truth, all with one scale.

    Args:
        views: keyframes of the run.
        true_depth: gives a frame's (H, W) truth in metres, or None.
        metres_per_unit: the scale of the trajectory's Sim(3) alignment; None: there is none.
        min_confidence: pixels below it are not compared.

    Returns:
        The scores with the scale of the trajectory and with the median of the depth ratios;
        None: no truth.
    """
    depths, truths, masks = [], [], []
    for view in views:
        truth = true_depth(view.frame)
        if truth is not None:
            depths.append(view.depth)
            truths.append(_nearest(truth, view.depth.shape))
            masks.append(view.confidence >= min_confidence)
    if not truths:
        return None
    scores: dict[str, Any] = {"num_keyframes": len(truths), "min_confidence": min_confidence}
    scores["by_median_ratio"] = asdict(evaluate_depth(depths, truths, masks))
    scores["by_trajectory_scale"] = None
    if metres_per_unit is not None:
        metric = [depth * np.float32(metres_per_unit) for depth in depths]
        scaled = replace(evaluate_depth(metric, truths, masks, "none"), scale=metres_per_unit)
        scores["by_trajectory_scale"] = asdict(scaled)
    return scores


def _nearest(image: NDArray[np.float32], size: tuple[int, ...]) -> NDArray[np.float32]:
    """Take the nearest pixel's value: averages over depth edges would be no truth."""
    rows, columns = (
        np.clip(((np.arange(new) + 0.5) * old / new).astype(int), 0, old - 1)
        for new, old in zip(size, image.shape, strict=True)
    )
    return image[np.ix_(rows, columns)]
