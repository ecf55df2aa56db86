"""Closures: a candidate measured and judged, and one record of it.

The similarity comes from matched pixels with depth in both windows, all pairs of neighbouring
frames in one fit, and from a window of both ends where the backbone takes one. What the images do
not show is no closure.
"""

from laser_slam.closures.ends import End, Matcher, PairMatches, make_matcher, match_ends
from laser_slam.closures.judgement import CandidateEnds, Judged, Tools, judge
from laser_slam.closures.loop_window import measure_by_window
from laser_slam.closures.matches import measure_by_matches
from laser_slam.closures.measurement import Measurement, disagreement
from laser_slam.closures.records import ACCEPTED, ClosureRecord, read_closures, write_closures

__all__ = [
    "ACCEPTED",
    "CandidateEnds",
    "ClosureRecord",
    "End",
    "Judged",
    "Matcher",
    "Measurement",
    "PairMatches",
    "Tools",
    "disagreement",
    "judge",
    "make_matcher",
    "match_ends",
    "measure_by_matches",
    "measure_by_window",
    "read_closures",
    "write_closures",
]
