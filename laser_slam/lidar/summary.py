"""What laser scans say, in a few lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


def summarize_lidar(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Give the lines of a summary: a name, and a value with its unit."""
    scans = f"{report['num_scans']:,} of {report['num_frames']:,} frames"
    yield "scans", f"{scans}, path of {report['path_length_m']:,.2f} m"
    errors = report["errors"]
    if errors is not None and errors["ate_se3_m"] is not None:
        yield "ATE of LiDAR", f"{errors['ate_se3_m']['rmse']:.3f} m RMSE against the truth"
    compared = report.get("comparison")
    if compared is None:
        return
    scale, spread = compared["scale"], compared["scale"]["by_stretches"]
    band = f" ({spread['p16']:.3f} to {spread['p84']:.3f} along the path)" if spread else ""
    yield "metric scale", f"{scale['metres_per_world_unit']:.3f} m per world unit{band}"
    yield from _summarize_path(compared["trajectory"])
    if compared["depth"] is None:
        yield "depth AbsRel", "no keyframe has a scan"
    else:
        yield from _summarize_depth(compared["depth"])
    yield from _summarize_cloud(compared["cloud"])


def _summarize_path(errors: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if errors["ate_sim3_m"] is None:
        yield "ATE of run", f"none: {errors['reason']}"
        return
    text = f"{errors['ate_sim3_m']['rmse']:.3f} m RMSE against LiDAR, Sim(3) aligned"
    kitti = errors["kitti"]
    if kitti["num_segments"]:
        text += f"; {kitti['t_rel_percent']:.2f} % and "
        text += f"{kitti['r_rel_deg_per_100m']:.2f} deg per 100 m"
    yield "ATE of run", text


def _summarize_depth(depth: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if depth["median_rel"] is None:
        yield "depth AbsRel", "no confident depth where laser points are"
        return
    scores = depth["by_trajectory_scale"]
    yield (
        "depth AbsRel",
        f"{scores['abs_rel']:.3f} with the scale of the path, "
        f"{depth['by_keyframe_ratio']['abs_rel']:.3f} with one for each keyframe; "
        f"median {depth['median_rel']:.3f}",
    )
    yield "", f"over the {scores['coverage']:.0%} of the laser points where depth is confident"
    bands = [f"{band['abs_rel']:.3f} to {band['to_m']} m" for band in depth["by_range"]]
    yield "", f"by distance: {', '.join(bands)}"


def _summarize_cloud(cloud: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if cloud["median_m"] is None:
        yield "map to scans", "no point of the map is within reach of a scan"
        return
    yield "map to scans", _distances(cloud)
    pieces = cloud["by_pieces"]
    if pieces["num_pieces"] > 1 and pieces["median_m"] is not None:
        yield "", f"{_distances(pieces)}, without drift"


def _distances(cloud: Mapping[str, Any]) -> str:
    shares = "/".join(f"{cloud[f'within_{cm}_cm']:.0%}" for cm in (10, 20, 50))
    return f"median {cloud['median_m']:.3f} m; {shares} within 10/20/50 cm"
