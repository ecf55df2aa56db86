"""A run as a rerun recording: what is logged where, and when."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import median_depth
from laser_slam.config import FusionConfig, ViewerConfig
from laser_slam.dependencies import import_rerun
from laser_slam.sim3 import Sim3, rotation_log
from laser_slam.types import Cloud, Layers, Submap, Trajectory
from laser_slam.viewer import arrangement as at
from laser_slam.viewer.base import CandidateRecord
from laser_slam.viewer.frames import FrameLogger
from laser_slam.viewer.pictures import class_colors
from laser_slam.viewer.points import PointBudget, Points, sample_points
from laser_slam.viewer.sinks import Sink

Array = NDArray[np.float64]

_CHAIN = (110, 160, 220)
_BRIDGED = (240, 150, 40)
_ACCEPTED = (70, 200, 110)
_REJECTED = (215, 70, 70)
_PLAIN = (150, 150, 150)


class RerunViewer:
    """Log a run to rerun.

    Points lie in the frames of their windows, and the windows' places beside them, so that a
    closure that moves hundreds of windows logs hundreds of Sim(3), and no point again. At each
    time a viewer shows what the run knew then.

    Args:
        sink: where the recording goes.
        config: how much is shown.
        fusion: which pixels the map leaves out.

    Raises:
        LaserSlamError: from all methods: the sink takes no more.
    """

    def __init__(self, sink: Sink, config: ViewerConfig, fusion: FusionConfig) -> None:
        self._rerun = import_rerun()
        self._sink = sink
        self._stream = sink.stream
        self._config = config
        self._fusion = fusion
        self._budget = PointBudget(config.points_per_window, config.max_points)
        self._frames = FrameLogger(sink.stream, config, fusion)
        self._places: list[Sim3] = []  # as they were logged last
        self._newest: Sequence[Sim3] = ()
        self._units: list[float] = []  # median depth of each window, in its own unit
        self._centers: dict[int, tuple[int, Array]] = {}  # of frames: window, and place in it
        self._verdicts: list[str] = []

    def window(self, submap: Submap, layers: Layers | None, times_s: Array) -> None:
        """Show the window that was added last, its frames each at its own time."""
        if not self._places:
            self._prepare()
        frames = submap.prediction.frames
        rows = np.flatnonzero(submap.is_owned & (frames > max(self._centers, default=-1)))
        if not len(rows):
            rows = np.array([len(frames) - 1])
        seen = submap.prediction
        unit = median_depth(seen.depth, seen.confidence, self._fusion.min_confidence)
        self._units.append(unit or (self._units[-1] if self._units else 1.0))
        for row in rows:
            center = submap.prediction.window_from_cam[row, :3, 3]
            self._centers[int(frames[row])] = submap.index, center
        self._set_time(int(frames[rows[0]]), float(times_s[rows[0]]))
        self._places.append(submap.world_from_window)
        self._log_place(submap.index, submap.world_from_window)
        self._frames.log(submap, layers, rows, times_s, self._units[-1])
        self._log_plots(submap)
        self._log_chain(submap, rows)
        if unit is not None:
            self._log_points(submap, rows, unit)
        self._sink.flush()

    def loops(self, places: Sequence[Sim3], records: Sequence[CandidateRecord]) -> None:
        """Show where windows are by now, and what became of the loop candidates so far."""
        self._newest = places
        has_moved = self._move(places, self._config.move_tolerance)
        if has_moved or [record.verdict for record in records] != self._verdicts:
            self._log_candidates(records)
        self._sink.flush()

    def results(self, cloud: Cloud, path: Trajectory, path_without_loops: Trajectory) -> None:
        """Show what the run ends with, at any time and in a view of its own."""
        self._move(self._newest, 0.0)
        rerun, num = self._rerun, min(len(cloud.points), self._config.max_points)
        kept = np.random.default_rng(0).choice(len(cloud.points), num, replace=False)
        kept.sort()
        points = rerun.Points3D(
            cloud.points[kept].astype(np.float32), colors=cloud.colors[kept], radii=_pixels(1.5)
        )
        self._stream.log(at.MAP, points, static=True)
        for entity, trajectory, color in (
            (at.PATH, path, _ACCEPTED),
            (at.PATH_WITHOUT_LOOPS, path_without_loops, _REJECTED),
        ):
            centers = trajectory.world_from_cam[:, :3, 3].astype(np.float32)
            line = rerun.LineStrips3D([centers], colors=[color], radii=_pixels(1.5))
            self._stream.log(entity, line, static=True)
        self._sink.flush()

    def close(self) -> None:
        """Show no more; what was shown stays."""
        self._sink.close()

    def _prepare(self) -> None:
        rerun = self._rerun
        self._sink.open()
        self._stream.send_blueprint(at.arrangement())
        for entity in (at.WORLD, "results"):
            self._stream.log(entity, rerun.ViewCoordinates.RDF, static=True)
        classes = rerun.AnnotationContext(class_colors())
        self._stream.log(at.LAYERS, classes, static=True)
        for entity, name in (
            (at.SCALE, "to the window before"),
            (at.WORLD_SCALE, "in the world"),
            (at.RESIDUAL, "median log-ratio of depths"),
        ):
            self._stream.log(entity, rerun.SeriesLines(names=[name]), static=True)

    def _set_time(self, frame: int, time_s: float) -> None:
        self._stream.set_time(at.FRAME, sequence=frame)
        self._stream.set_time(at.TIME, duration=time_s)

    def _log_place(self, index: int, world_from_window: Sim3) -> None:
        """Log the Sim(3) of a window; rerun scales, turns, then shifts, as ours does."""
        place = self._rerun.Transform3D(
            scale=world_from_window.scale,
            mat3x3=world_from_window.rotation,
            translation=world_from_window.translation,
            child_frame=window_frame(index),
            parent_frame=f"tf#/{at.WORLD}",
        )
        self._stream.log(at.PLACES, place)

    def _move(self, places: Sequence[Sim3], tolerance: float) -> bool:
        """Log the windows that are further from where they are shown than a tolerance."""
        moved = [
            index
            for index, (old, new) in enumerate(zip(self._places, places, strict=False))
            if new is not old and _motion(old, new, self._units[index]) > tolerance
        ]
        for index in moved:
            self._places[index] = places[index]
            self._log_place(index, places[index])
        if moved and moved[-1] == len(self._places) - 1:
            self._frames.log_camera(places[-1])
        return bool(moved)

    def _log_points(self, submap: Submap, rows: NDArray[np.int64], unit: float) -> None:
        points = sample_points(submap, rows, self._budget.per_window, self._fusion, unit)
        for index, drawn in self._budget.add(submap.index, points).items():
            self._log_cloud(index, drawn)

    def _log_cloud(self, index: int, points: Points) -> None:
        cloud = self._rerun.Points3D(points[0], colors=points[1], radii=_pixels(1.5))
        self._stream.log(window_entity(index), cloud)

    def _log_chain(self, submap: Submap, rows: NDArray[np.int64]) -> None:
        """Log a window's piece of the path, which begins where the last one ends, and its node."""
        rerun, registration = self._rerun, submap.registration
        is_bridged = registration is not None and registration.bridged is not None
        centers = submap.prediction.window_from_cam[:, :3, 3].astype(np.float32)
        color = _BRIDGED if is_bridged else _CHAIN
        size = np.float32(0.02 * self._units[-1])
        self._stream.log(
            window_entity(submap.index),
            rerun.CoordinateFrame(window_frame(submap.index)),
            rerun.LineStrips3D([centers[max(0, rows[0] - 1) :]], colors=[color], radii=_pixels(2)),
            rerun.Boxes3D(centers=centers[rows[:1]], half_sizes=[[size] * 3], colors=[color]),
        )
        if registration is not None and registration.bridged:
            text = f"window {submap.index} is bridged: {registration.bridged}"
            self._stream.log(at.EVENTS, rerun.TextLog(text, level="WARN"))

    def _log_plots(self, submap: Submap) -> None:
        scalars = self._rerun.Scalars
        self._stream.log(at.WORLD_SCALE, scalars(submap.world_from_window.scale))
        registration = submap.registration
        if registration is not None and not registration.bridged:
            self._stream.log(at.SCALE, scalars(registration.previous_from_current.scale))
            self._stream.log(at.RESIDUAL, scalars(registration.residual))

    def _log_candidates(self, records: Sequence[CandidateRecord]) -> None:
        rerun = self._rerun
        for kind, color, is_accepted in (
            (at.ACCEPTED, _ACCEPTED, True),
            (at.REJECTED, _REJECTED, False),
        ):
            some = [
                record
                for record in records
                if record.is_accepted == is_accepted and self._knows(record)
            ]
            lines = [
                [self._center(record.frame_a), self._center(record.frame_b)] for record in some
            ]
            labels = [f"{r.frame_a} - {r.frame_b}: {r.verdict}" for r in some]
            strips = rerun.LineStrips3D(
                np.array(lines, np.float32).reshape(-1, 2, 3),
                colors=[color],
                radii=_pixels(2.5 if is_accepted else 1),
                labels=labels,
                show_labels=False,
            )
            self._stream.log(kind, strips)
        for i, record in enumerate(records):
            if i >= len(self._verdicts) or record.verdict != self._verdicts[i]:
                text = f"frames {record.frame_a} and {record.frame_b}: {record.verdict}"
                level = "INFO" if record.is_accepted else "DEBUG"
                self._stream.log(at.EVENTS, rerun.TextLog(text, level=level))
        self._verdicts = [record.verdict for record in records]

    def _knows(self, record: CandidateRecord) -> bool:
        return record.frame_a in self._centers and record.frame_b in self._centers

    def _center(self, frame: int) -> Array:
        """Return where a frame's camera is in the world, as the windows lie now."""
        window, center = self._centers[frame]
        return self._places[window].apply(center)


def window_entity(index: int) -> str:
    """Return the entity of a window."""
    return f"{at.WINDOWS}/{index:06d}"


def window_frame(index: int) -> str:
    """Return rerun's name of a window's coordinate frame."""
    return f"window {index}"


def _pixels(radius: float) -> float:
    """Return a radius that stays the same however near one is, which rerun writes below zero."""
    return -radius


def _motion(old: Sim3, new: Sim3, unit: float) -> float:
    """Return how far a window's points at its median depth have moved, in median depths."""
    change = old.inverse() @ new
    turn = float(np.linalg.norm(rotation_log(change.rotation)))
    shift = float(np.linalg.norm(change.translation)) / unit
    return shift + turn + abs(float(np.log(change.scale)))
