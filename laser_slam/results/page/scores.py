"""The page's numbers of a run, and what the truth says."""

from __future__ import annotations

from laser_slam.report.html import Block, Number, Numbers, Section, Table, Text
from laser_slam.results.page.reading import (
    Report,
    count,
    look,
    number,
    percent,
    say,
)

_WITHOUT = "closures.trajectory_without"


def headline(report: Report) -> Numbers:
    """Gather the numbers that matter most; where one is unknown, its note says why."""
    return Numbers([*_trajectory_numbers(report), _depth_number(report), *_run_numbers(report)])


def _trajectory_numbers(report: Report) -> list[Number]:
    reason = _why_unscored(report)
    length = say(number(report, "trajectory.path_length_m"))
    notes = [reason] * 3
    if not reason:
        without = say(number(report, f"{_WITHOUT}.ate_sim3_m.rmse"))
        notes[0] = f"RMSE, Sim(3), over {length} m" + (
            f"; {without} m without loops"
            if without and number(report, "closures.accepted")
            else ""
        )
        segments = number(report, "trajectory.kitti.num_segments")
        notes[1:] = [
            f"{count(segments)} segments of 100 m to 800 m"
            if segments
            else f"the path of {length} m has no segment of 100 m"
        ] * 2
    kitti = "trajectory.kitti"
    return [
        Number("ATE", say(number(report, "trajectory.ate_sim3_m.rmse")), "m", notes[0]),
        Number("t_rel", say(number(report, f"{kitti}.t_rel_percent")), "%", notes[1]),
        Number("r_rel", say(number(report, f"{kitti}.r_rel_deg_per_100m")), "°/100 m", notes[2]),
    ]


def _why_unscored(report: Report) -> str:
    """Return why the trajectory has no scores; empty: it has."""
    if not look(report, "trajectory"):
        return "no true poses to compare with"
    return str(look(report, "trajectory.reason") or "")


def _depth_number(report: Report) -> Number:
    for name, scaling in (
        ("by_trajectory_scale", "scale of the trajectory"),
        ("by_median_ratio", "scale by the median ratio"),
    ):
        value = number(report, f"depth.{name}.abs_rel")
        if value is not None:
            coverage = percent(number(report, f"depth.{name}.coverage"), 2)
            keyframes = count(number(report, "depth.num_keyframes"))
            note = f"{keyframes} keyframes, {coverage} of their pixels; {scaling}"
            return Number("AbsRel of depth", say(value), "", note)
    why = "no true depth to compare with" if not look(report, "depth") else "no depth to compare"
    return Number("AbsRel of depth", "", "", why)


def _run_numbers(report: Report) -> list[Number]:
    seconds = say(number(report, "seconds.wall_in_all"))
    memory = number(report, "peak_memory_mib")
    points, voxel = number(report, "map.num_points"), say(number(report, "map.voxel_size"))
    return [
        Number(
            "Frames per second",
            say(number(report, "frames_per_second")),
            "",
            f"{seconds} s in all, everything included" if seconds else "not measured",
        ),
        Number(
            "Peak memory",
            "" if memory is None else say(memory / 1024),
            "GiB",
            "" if memory is not None else "this system does not tell",
        ),
        _loops_number(report),
        Number(
            "Points of the map",
            count(points),
            "",
            "the map is empty"
            if points == 0
            else f"voxels of {voxel} world units"
            if voxel
            else "",
        ),
    ]


def _loops_number(report: Report) -> Number:
    accepted = number(report, "closures.accepted")
    if accepted is None:
        return Number("Loops closed", "", "", "loops were not looked for")
    candidates = count(number(report, "closures.candidates"))
    distrusted = number(report, "closures.distrusted")
    also = f"; {count(distrusted)} left out by the pose graph" if distrusted else ""
    return Number("Loops closed", count(accepted), "", f"of {candidates} candidates{also}")


def accuracy(report: Report) -> Section:
    """Show all scores with their units."""
    blocks: list[Block] = []
    reason = _why_unscored(report)
    if reason:
        blocks.append(Text(f"The trajectory is not scored: {reason}."))
    else:
        blocks += [_trajectory_table(report), _kitti_table(report)]
    if look(report, "depth"):
        blocks.append(_depth_table(report))
    else:
        blocks.append(Text("Depth is not scored: no true depth to compare with."))
    return Section("accuracy", "Accuracy", blocks)


_NAMES = ("rmse", "mean", "median", "max")
_STATISTICS = (
    ("ate_sim3_m", "ATE, Sim(3) alignment (m)"),
    ("ate_se3_m", "ATE, SE(3) alignment, own scale (m)"),
    ("rpe_translation_m", "RPE over one frame, translation (m)"),
    ("rpe_rotation_deg", "RPE over one frame, rotation (°)"),
)
_KITTI = (
    ("kitti.t_rel_percent", "t_rel, scale aligned (%)"),
    ("kitti.r_rel_deg_per_100m", "r_rel (°/100 m)"),
    ("kitti_unscaled.t_rel_percent", "t_rel, own scale (%)"),
)


def _trajectory_table(report: Report) -> Table:
    has_both = bool(look(report, _WITHOUT))
    rows = [
        [
            label,
            *(say(number(report, f"trajectory.{key}.{name}")) for name in _NAMES),
            *([say(number(report, f"{_WITHOUT}.{key}.rmse"))] if has_both else []),
        ]
        for key, label in _STATISTICS
    ]
    caption = (
        f"Trajectory: {count(number(report, 'trajectory.num_frames'))} frames, "
        f"{say(number(report, 'trajectory.path_length_m'), 4)} m, "
        f"{say(number(report, 'trajectory.scale'), 4)} m per world unit"
    )
    head = ["error", "RMSE", "mean", "median", "max"]
    return Table(caption, [*head, *(["RMSE without loops"] if has_both else [])], rows)


def _kitti_table(report: Report) -> Block:
    num = number(report, "trajectory.kitti.num_segments")
    if not num:
        return Text("KITTI's t_rel and r_rel need segments of 100 m; the path has none.")
    has_both = bool(look(report, _WITHOUT))
    ends = ["trajectory", *([_WITHOUT] if has_both else [])]
    rows = [
        [label, *(say(number(report, f"{end}.{key}")) for end in ends)] for key, label in _KITTI
    ]
    caption = f"KITTI's scores: means over {count(num)} segments of 100 m to 800 m"
    return Table(caption, ["error", "mean", *(["without loops"] if has_both else [])], rows)


_DEPTHS = (
    ("depth.by_trajectory_scale", "scale of the trajectory"),
    ("depth.by_median_ratio", "median ratio"),
    ("depth_without_layers.by_trajectory_scale", "scale of the trajectory, without layer scales"),
    ("depth_without_layers.by_median_ratio", "median ratio, without layer scales"),
)


def _depth_table(report: Report) -> Table:
    rows = [
        [
            label,
            say(number(report, f"{key}.abs_rel")),
            percent(number(report, f"{key}.delta_125")),
            say(number(report, f"{key}.rmse_log")),
            percent(number(report, f"{key}.coverage")),
            count(number(report, f"{key}.num_pixels")),
            say(number(report, f"{key}.scale"), 4),
        ]
        for key, label in _DEPTHS
        if look(report, key)
    ]
    least = say(number(report, "depth.min_confidence"), 2)
    caption = (
        f"Depth of {count(number(report, 'depth.num_keyframes'))} keyframes, "
        f"pixels of confidence {least} and more"
    )
    head = ["scaled by", "AbsRel", "δ < 1.25", "RMSE of log", "coverage", "pixels", "m per unit"]
    return Table(caption, head, rows)
