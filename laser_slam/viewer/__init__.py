"""Watch a run: in a window, in a browser, in a file, or not at all."""

from laser_slam.viewer.base import BestEffortViewer, CandidateRecord, NullViewer, Viewer
from laser_slam.viewer.recording import RerunViewer
from laser_slam.viewer.sinks import BrowserSink, FileSink, Sink, WindowSink, has_display

__all__ = [
    "BestEffortViewer",
    "BrowserSink",
    "CandidateRecord",
    "FileSink",
    "NullViewer",
    "RerunViewer",
    "Sink",
    "Viewer",
    "WindowSink",
    "has_display",
]
