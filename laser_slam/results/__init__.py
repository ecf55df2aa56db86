"""What a finished run leaves: scores against the truth, files, pictures, the report."""

from laser_slam.results.pictures import (
    draw_depth,
    draw_layers,
    draw_map,
    draw_trajectory,
    write_trajectories,
)
from laser_slam.results.report import (
    Results,
    describe_layers,
    describe_sequence,
    peak_memory_mib,
    versions,
    write_report,
)
from laser_slam.results.scores import (
    KeyframeView,
    Scores,
    sample_views,
    score_views,
)

__all__ = [
    "KeyframeView",
    "Results",
    "Scores",
    "describe_layers",
    "describe_sequence",
    "draw_depth",
    "draw_layers",
    "draw_map",
    "draw_trajectory",
    "peak_memory_mib",
    "sample_views",
    "score_views",
    "versions",
    "write_report",
    "write_trajectories",
]
