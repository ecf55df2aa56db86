"""What a run leaves: scores against the truth, files, pictures, the report."""

from laser_slam.results.findings import Findings, draw_findings, write_findings
from laser_slam.results.keyframes import list_keyframes
from laser_slam.results.loops import CHAINED_FILE, Loops, describe_loops, look_back
from laser_slam.results.mapping import TILES, fuse_run, place_window
from laser_slam.results.page import read_report, write_report_page
from laser_slam.results.paths import describe_paths
from laser_slam.results.pictures import draw_trajectory
from laser_slam.results.raw import RawCloud
from laser_slam.results.report import (
    Results,
    describe_layers,
    describe_sequence,
    describe_system,
    write_report,
)
from laser_slam.results.scores import (
    KeyframeView,
    Scores,
    sample_views,
    score_views,
)
from laser_slam.results.windows import describe_course, describe_windows, rescale_windows

__all__ = [
    "CHAINED_FILE",
    "TILES",
    "Findings",
    "KeyframeView",
    "Loops",
    "RawCloud",
    "Results",
    "Scores",
    "describe_course",
    "describe_layers",
    "describe_loops",
    "describe_paths",
    "describe_sequence",
    "describe_system",
    "describe_windows",
    "draw_findings",
    "draw_trajectory",
    "fuse_run",
    "list_keyframes",
    "look_back",
    "place_window",
    "read_report",
    "rescale_windows",
    "sample_views",
    "score_views",
    "write_findings",
    "write_report",
    "write_report_page",
]
