"""What became of each window, for the report."""

from __future__ import annotations

from typing import Any

from laser_slam.results.findings import Findings
from laser_slam.results.loop_pictures import scale_curves
from laser_slam.results.paths import describe_paths, on_truth
from laser_slam.slam import Node, Slam
from laser_slam.types import Registration


def describe_windows(slam: Slam, found: Findings) -> dict[str, Any]:
    """Tell of each window its frames, its registration and its scale along the path.

    Scales are metres per window unit where there is truth, else world units per window unit;
    with truth, each path has its own alignment.

    Args:
        slam: that placed the windows.
        found: by the run.
    """
    paths = [found.trajectory] if found.loops is None else [found.trajectory, found.loops.chained]
    (closed, *_), truth, scales = on_truth(paths, found.truth)
    curves = scale_curves(slam.nodes, closed, truth, (scales[-1], scales[0]))
    of_window: dict[int, dict[str, Any]] = {}
    used = [node for node in slam.nodes if node.is_owned.any()]
    for i, node in enumerate(used):
        of_window[node.index] = {
            "distance": curves.distances[i],
            "scale": curves.closed[i],
            "scale_without_loops": None if found.loops is None else curves.chained[i],
            "true_scale": None if curves.truth is None else curves.truth[i],
        }
    unit = "world units" if truth is None else "m"
    return {
        "num": len(slam.nodes),
        "bridged": slam.bridged,
        "unit": unit,
        "records": [
            {**_describe_node(node), **of_window.get(node.index, {})} for node in slam.nodes
        ],
    }


def _describe_node(node: Node) -> dict[str, Any]:
    return {
        "window": node.index,
        "first_frame": int(node.frames[0]),
        "last_frame": int(node.frames[-1]),
        "registration": _describe_registration(node.registration),
    }


def _describe_registration(registration: Registration | None) -> dict[str, Any] | None:
    """Return what was measured; None: nothing was."""
    if registration is None or registration.bridged:
        return None
    return {
        "scale": registration.previous_from_current.scale,
        "scale_sigma_percent": 100 * float(registration.sigmas[6]),
        "residual": registration.residual,
        "num_pixels": registration.num_pixels,
    }


def rescale_windows(
    windows: dict[str, Any], metres: tuple[float | None, float | None], *, has_same_truth: bool
) -> dict[str, Any]:
    """Put the windows' scales into the metres of another alignment to the truth.

    Args:
        windows: as ``describe_windows`` gives them.
        metres: of the new alignment per unit that the windows have so far: of the path with
            the loops closed, and of the one without; None: there is no such path.
        has_same_truth: False: the true scales of the windows are no longer known.
    """
    factors = {"distance": metres[0], "scale": metres[0], "scale_without_loops": metres[1]}
    records = []
    for old in windows["records"]:
        new = dict(old)
        for name, factor in factors.items():
            if new.get(name) is not None:
                new[name] = None if factor is None else factor * new[name]
        if not has_same_truth:
            new["true_scale"] = None
        records.append(new)
    return {**windows, "unit": "m", "records": records}


def describe_course(found: Findings) -> dict[str, Any]:
    """Keep the paths of a run and their errors; see ``describe_paths``."""
    loops = found.loops
    return describe_paths(
        found.trajectory,
        None if loops is None else loops.chained,
        found.truth,
        (found.scores.trajectory, None if loops is None else loops.errors),
    )
