"""The state machine: add windows one by one, know where every frame was."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import Config
from laser_slam.errors import DegenerateGeometryError
from laser_slam.layers import (
    LayerCounts,
    Segmenter,
    align_layers,
    apply_layers,
    first_layers,
    make_segmenter,
    smooth_layers,
)
from laser_slam.pose_graph import Optimised, PoseGraph, spread_corrections, spread_poses
from laser_slam.registration import bridge, register
from laser_slam.sim3 import Sim3, complete_poses
from laser_slam.slam.node import Node
from laser_slam.store import WindowFiles
from laser_slam.types import (
    Image,
    Layers,
    Prediction,
    Registration,
    Submap,
    Trajectory,
    WindowStatus,
)

Array = NDArray[np.float64]

Stage = Callable[[str], AbstractContextManager[None]]
logger = logging.getLogger(__name__)


def no_clock(_name: str) -> AbstractContextManager[None]:
    """Charge nothing."""
    return nullcontext()


class Slam:
    """Chain windows into one world; memory grows by a few kilobytes per window.

    The world is the frame of the first window's first camera, in the first window's unit.

    Attributes:
        nodes: the places of all windows so far, in order.
        layers: of the window added last; None: they are not looked at.
        optimised: what the last closure has brought; None: there is none.
    """

    def __init__(self, config: Config, stage: Stage = no_clock) -> None:
        """Start with no window.

        Args:
            config: all settings.
            stage: is entered with the name of what is being done, to charge time to it.
        """
        self._config = config
        self._stage = stage
        self._last: Prediction | None = None
        self._segmenter: Segmenter | None = None
        if config.has_layers:
            self._segmenter = make_segmenter(config.layers.segmentation)
        self._graph: PoseGraph | None = None
        self.optimised: Optimised | None = None
        self.nodes: list[Node] = []
        self.layers: Layers | None = None

    def add(self, prediction: Prediction, colors: Image) -> Submap:
        """Place the next window and align its layers with those of the window before.

        A window that cannot be registered is bridged: one warning, and ``bridged`` names it.

        Args:
            prediction: of the window that follows the last one added, sharing frames with it.
            colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.

        Returns:
            The submap, as far as is known now: the next window may yet take its last frames.
        """
        placed = _without_failure(prediction, self._last)
        if self._last is None:
            if placed.status is not WindowStatus.OK:
                logger.warning("window 0 has no depth: %s", _STATUS_IN_WORDS[placed.status])
            first_from_window = Sim3.from_matrix(placed.window_from_cam[0]).inverse()
            self._append(placed, first_from_window, None)
        else:
            with self._stage("register"):
                registration = self._register(self._last, placed)
            self._split_shared_frames(placed)
            world_from_previous = self.nodes[-1].world_from_window
            self._append(
                placed, world_from_previous @ registration.previous_from_current, registration
            )
        with self._stage("layers"):
            self._align_layers(placed, colors)
        self._last = placed
        return self.nodes[-1].submap(self.corrected(prediction), colors)

    def corrected(self, prediction: Prediction) -> Prediction:
        """Return the window added last with its layers' scales applied."""
        if self.layers is None:
            return prediction
        return apply_layers(prediction, self.layers, self._config.layers)

    def smooth_layers(self, files: WindowFiles) -> None:
        """Let the layers of early windows learn from later ones, once all windows are stored.

        Args:
            files: of the run; those of the layers are written anew.
        """
        if not self._config.smooths_layers:
            return
        backwards = self.nodes[::-1]
        windows = (
            (files.load_depth(node.index), files.load_layers(node.index), node.measured_scale)
            for node in backwards
        )
        smoothed = smooth_layers(windows, self._config.layers)
        for node, layers in zip(backwards, smoothed, strict=True):
            files.save_layers(node.index, layers)

    @property
    def bridged(self) -> dict[int, str]:
        """Name the windows whose place is a guess, and why."""
        reasons = {node.index: node.registration for node in self.nodes}
        return {index: r.bridged for index, r in reasons.items() if r is not None and r.bridged}

    @property
    def num_keyframes(self) -> int:
        """Count the keyframes of all windows, each once."""
        return sum(int(node.is_owned.sum()) for node in self.nodes)

    def close(self, a: int, b: int, a_from_b: Sim3, sigmas: Array) -> bool:
        """Close a loop: windows move to where chain and closures agree best.

        Args:
            a: index of a window.
            b: index of another that saw the same place.
            a_from_b: measured.
            sigmas: (7,) as in ``Registration.sigmas``, a being the previous window.

        Returns:
            Whether the graph trusts it; an earlier closure may lose its trust by it.

        Raises:
            DegenerateGeometryError: a window is unknown, a sigma is not positive and finite, or
                the graph cannot be solved with it; all stays as it was.
        """
        with self._stage("optimise"):
            graph = self.pose_graph()
            graph.add_closure(a, b, a_from_b, sigmas)
            try:
                self.optimised = graph.optimise()
            except DegenerateGeometryError:
                graph.drop_closure()
                raise
            places = self.optimised.world_from_window
            self.nodes = [
                replace(node, world_from_window=places[node.index]) for node in self.nodes
            ]
        return bool(self.optimised.is_trusted[-1])

    def pose_graph(self) -> PoseGraph:
        """Return the graph of all windows so far, with the closures in it."""
        if self._graph is None:
            self._graph = PoseGraph(self._config.pose_graph)
        for node in self.nodes[len(self._graph) :]:
            self._graph.add_window(node.index, node.world_from_window)
            if node.registration is not None:
                self._graph.add_registration(node.index - 1, node.index, node.registration)
        return self._graph

    def frame_places(self) -> list[list[Sim3]]:
        """Return ``world_from_window`` of each frame that each window owns.

        What closures have moved is spread over the frames: none jumps at a window's border.
        """
        return spread_corrections([node.moved for node in self.nodes])

    def trajectory(self, times_s: Array, *, closed: bool = True) -> Trajectory:
        """Return the pose of every keyframe, each from the window that owns it.

        Args:
            times_s: seconds of the sequence's frames, by frame index.
            closed: False: as the registrations alone chain the windows, without closures.

        Returns:
            ``world_from_cam`` of the keyframes, in world units.
        """
        owned = np.concatenate([node.frames[node.is_owned] for node in self.nodes])
        windows = [node.moved for node in self.nodes]
        if not closed:
            windows = [replace(window, after=window.before) for window in windows]
        world_from_cam = spread_poses(windows)
        return Trajectory(owned, times_s[owned], world_from_cam)

    def _align_layers(self, placed: Prediction, colors: Image) -> None:
        if self._segmenter is None:
            return
        labels = self._segmenter.segment(placed, colors)
        scale = self.nodes[-1].measured_scale
        previous = None if self._last is None or self.layers is None else (self._last, self.layers)
        if previous is None or scale is None:
            self.layers = first_layers(labels)  # there is no scale that layers could differ from
            counts = LayerCounts(len(self.layers.scales))
        else:
            self.layers, counts = align_layers(previous, placed, labels, scale, self._config.layers)
        self.nodes[-1] = replace(self.nodes[-1], layers=counts)

    def _append(
        self, placed: Prediction, world_from_window: Sim3, registration: Registration | None
    ) -> None:
        start = self.nodes[-1].owned[1] if self.nodes else int(placed.frames[0])
        end = int(placed.frames[-1]) + 1
        # The chain goes on from where closures have moved it, by the same correction.
        chained = world_from_window
        if self.nodes:
            last = self.nodes[-1]
            chained = last.chained @ last.world_from_window.inverse() @ world_from_window
        self.nodes.append(
            Node(
                len(self.nodes),
                placed.frames,
                placed.window_from_cam,
                chained,
                world_from_window,
                (start, max(start, end)),
                registration,
            )
        )

    def _split_shared_frames(self, placed: Prediction) -> None:
        """Give the first half of the shared frames to the last window, the rest to the new one.

        Window ends are the least certain, so the middle of the overlap is the best border.
        """
        last = self.nodes[-1]
        shared = np.intersect1d(last.frames, placed.frames)
        border = int(shared[len(shared) // 2]) if len(shared) else int(placed.frames[0])
        self.nodes[-1] = replace(last, owned=(last.owned[0], max(last.owned[0], border)))

    def _register(self, last: Prediction, placed: Prediction) -> Registration:
        reason = _unregistrable(last, placed)
        if reason is None:
            try:
                if self._config.layers.feed_back:
                    last = self.corrected(last)
                return register(last, placed, self._config.registration)
            except DegenerateGeometryError as error:
                reason = str(error)
        logger.warning("window %d is bridged: %s", len(self.nodes), reason)
        return bridge(last, placed, reason)


_STATUS_IN_WORDS = {
    WindowStatus.STATIC: "the camera stands still",
    WindowStatus.ROTATION: "the camera only turns",
    WindowStatus.FAILED: "too little can be seen",
}


def _unregistrable(last: Prediction, placed: Prediction) -> str | None:
    if placed.status is not WindowStatus.OK:
        return _STATUS_IN_WORDS[placed.status]
    if last.status is not WindowStatus.OK:
        return f"no depth in the window before, where {_STATUS_IN_WORDS[last.status]}"
    return None


def _without_failure(prediction: Prediction, last: Prediction | None) -> Prediction:
    """Replace the poses of a failed window by a continuation of the last window's motion."""
    if prediction.status is not WindowStatus.FAILED:
        return prediction
    if last is None:
        standing = np.tile(np.eye(4), (len(prediction.frames), 1, 1))
        return replace(prediction, window_from_cam=standing)
    return replace(
        prediction,
        window_from_cam=complete_poses(prediction.frames, last.frames, last.window_from_cam),
    )
