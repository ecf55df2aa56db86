"""Errors of depth maps against the truth, after the scale that no single camera knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]
AnyDepth = NDArray[np.float32] | NDArray[np.float64]
Mask = NDArray[np.bool_]
Alignment = Literal["median", "least_squares", "none"]


@dataclass(frozen=True)
class DepthErrors:
    """How far depth is from the truth over the chosen pixels; None: nothing to compare.

    Attributes:
        abs_rel: mean of |depth - truth| / truth.
        delta_125: share of the pixels whose depth is within a factor 1.25 of the truth.
        rmse_log: root mean square of log(depth / truth).
        scale: metres per unit of depth that was applied first.
        num_pixels: compared pixels.
        coverage: their share of the pixels whose truth is known; None: no truth.
    """

    abs_rel: float | None
    delta_125: float | None
    rmse_log: float | None
    scale: float | None
    num_pixels: int
    coverage: float | None


def evaluate_depth(
    depth: Depth | Sequence[Depth],
    truth: Depth | Sequence[Depth],
    mask: Mask | Sequence[Mask] | None = None,
    alignment: Alignment = "median",
) -> DepthErrors:
    """Compare depth maps with the truth, all with one scale.

    Args:
        depth: one or more (H, W) maps in any unit; not finite or not positive: unknown.
        truth: as many maps of the same size in metres; unknown likewise.
        mask: pixels to compare, such as ``confidence > 0.5``; None: all known ones.
        alignment: ``median``: median of the ratios; ``least_squares``: the best scale of depth in
            metres, which far pixels rule; ``none``: depth is metric already.

    Raises:
        ValueError: shapes disagree.
    """
    found, true = _flat(depth), _flat(truth)
    chosen = np.ones(found.shape, dtype=bool) if mask is None else _flat(mask).astype(bool)
    if found.shape != true.shape or found.shape != chosen.shape:
        raise ValueError(f"depth {found.shape}, truth {true.shape}, mask {chosen.shape} pixels")
    has_truth = is_known(true)
    compared = chosen & has_truth & is_known(found)
    num_true, num = int(has_truth.sum()), int(compared.sum())
    coverage = num / num_true if num_true else None
    if num == 0:
        return DepthErrors(None, None, None, None, 0, coverage)
    found, true = found[compared], true[compared]
    scale = _scale(found, true, alignment)
    log_ratio = np.log(scale * found / true)
    return DepthErrors(
        abs_rel=float(np.mean(np.abs(scale * found - true) / true)),
        delta_125=float(np.mean(np.abs(log_ratio) < np.log(1.25))),
        rmse_log=float(np.sqrt(np.mean(log_ratio**2))),
        scale=scale,
        num_pixels=num,
        coverage=coverage,
    )


def _flat(maps: Depth | Mask | Sequence[Depth] | Sequence[Mask]) -> NDArray[np.float64]:
    return np.concatenate([np.empty(0), *(np.ravel(part) for part in maps)]).astype(np.float64)


def is_known(depth: AnyDepth) -> Mask:
    """Tell where depth of any shape is finite and positive."""
    return np.isfinite(depth) & (depth > 0)


def _scale(found: NDArray[np.float64], true: NDArray[np.float64], alignment: Alignment) -> float:
    if alignment == "median":
        return float(np.median(true / found))
    if alignment == "least_squares":
        return float(found @ true / (found @ found))
    return 1.0
