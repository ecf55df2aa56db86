"""Loops: places that are seen again, and what the pose graph makes of them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from laser_slam.closures import CandidateEnds, ClosureRecord, End, Tools, judge
from laser_slam.config import Config
from laser_slam.errors import DegenerateGeometryError
from laser_slam.places import (
    BACKBONE,
    Candidate,
    CandidateSearch,
    Place,
    describe_by_tokens,
    make_descriptor,
)
from laser_slam.places.base import Descriptor
from laser_slam.places.similarity import SimilarityMap
from laser_slam.slam.chain import Slam
from laser_slam.slam.node import Node
from laser_slam.slam.stored import read_window
from laser_slam.store import WindowFiles
from laser_slam.types import Image, Prediction, WindowStatus

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


class LoopCloser:
    """Look for places seen before as windows come, and close the loops that hold.

    A window is looked at when the next one is there, for only then it is known which frames it
    owns. Kept in memory are descriptors, records and that one window; older ones are read back.
    """

    def __init__(self, config: Config, slam: Slam, files: WindowFiles, tools: Tools) -> None:
        """Start with no place.

        Args:
            config: all settings.
            slam: whose windows are looked at, and moved.
            files: where the run's windows are.
            tools: what candidates are measured with.
        """
        self._config = config
        self._slam = slam
        self._files = files
        self._tools = tools
        self._descriptor: Descriptor | None = None
        if config.places.descriptor != BACKBONE:
            self._descriptor = make_descriptor(config.places)
        self._search: CandidateSearch | None = None  # until the length of descriptors is known
        self._waiting: tuple[Prediction, Image] | None = None
        self._travelled = 0.0
        self._unit = 1.0  # median depth of the last window that had one
        self._records: list[ClosureRecord] = []
        self._closed: list[int] = []  # which of the records are in the graph, in its order

    @property
    def records(self) -> list[ClosureRecord]:
        """Return what became of each candidate; the pose graph has the last word."""
        records = list(self._records)
        optimised = self._slam.optimised
        if optimised is None:
            return records
        for row, trusted, misfit in zip(
            self._closed, optimised.is_trusted, optimised.misfits, strict=True
        ):
            if not trusted:
                verdict = f"the pose graph distrusts it, {misfit:.1f} sigmas off"
                records[row] = replace(records[row], verdict=verdict)
        return records

    @property
    def num_distrusted(self) -> int:
        """Count the closures that passed all checks and were left out by the pose graph."""
        optimised = self._slam.optimised
        return 0 if optimised is None else int((~optimised.is_trusted).sum())

    def similarity_map(self) -> SimilarityMap:
        """Return how much all keyframes so far resemble each other."""
        return (self._search or CandidateSearch(self._config.places, 1)).similarity_map()

    def add(self, prediction: Prediction, colors: Image) -> None:
        """Look at the window before the one that was added last.

        Args:
            prediction: of the window added last, its layers' scales applied.
            colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.
        """
        if self._waiting is not None:
            self._look(self._slam.nodes[-2], *self._waiting)
        self._waiting = prediction, colors

    def finish(self) -> None:
        """Look at the last window."""
        if self._waiting is not None:
            self._look(self._slam.nodes[-1], *self._waiting)
        self._waiting = None

    def _look(self, node: Node, prediction: Prediction, colors: Image) -> None:
        places = list(self._places(node, prediction))
        if prediction.status is not WindowStatus.OK or not places:
            return
        rows = np.searchsorted(node.frames, [place.frame for place in places])
        descriptors = self._describe(prediction, colors, rows)
        if self._search is None:
            self._search = CandidateSearch(self._config.places, descriptors.shape[1])
        for candidate in self._search.add(places, descriptors):
            self._examine(candidate, prediction, colors)

    def _describe(
        self, prediction: Prediction, colors: Image, rows: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        if self._descriptor is None:
            return describe_by_tokens(prediction, rows)
        return np.stack([self._descriptor.describe(colors[row]) for row in rows])

    def _places(self, node: Node, prediction: Prediction) -> Iterator[Place]:
        """Give the frames that a window owns, with the way to them in median depths.

        A window that failed has poses in the unit of the one before.
        """
        known = prediction.depth[:, ::4, ::4]
        known = known[known > 0]
        if known.size:
            self._unit = float(np.median(known))
        centers = node.window_from_cam[:, :3, 3]
        steps = np.linalg.norm(np.diff(centers, axis=0, prepend=centers[:1]), axis=1) / self._unit
        for row in np.flatnonzero(node.is_owned):
            self._travelled += float(steps[row])
            yield Place(int(node.frames[row]), node.index, self._travelled)

    def _examine(self, candidate: Candidate, prediction: Prediction, colors: Image) -> None:
        older, newer = candidate.older, candidate.newer
        stored = read_window(self._files, older.window, self._config)
        a = _end(older, stored.corrected, stored.colors)
        b = _end(newer, prediction, colors)
        nodes = self._slam.nodes
        chain_scale = (
            nodes[newer.window].world_from_window.scale
            / nodes[older.window].world_from_window.scale
        )
        between = [node.registration for node in nodes[older.window + 1 : newer.window + 1]]
        guesses = [link.sigmas[6] for link in between if link is not None and link.bridged]
        guess_sigma = float(np.linalg.norm(guesses))
        ends = CandidateEnds(a, b, candidate.similarity, chain_scale, guess_sigma)
        judged = judge(ends, self._tools, self._config)
        record, found = judged.record, judged.measurement
        if found is not None:
            try:
                self._slam.close(a.window, b.window, found.a_from_b, found.sigmas)
                self._closed.append(len(self._records))
            except DegenerateGeometryError as error:
                record = replace(record, verdict=str(error))
        self._records.append(record)
        logger.info("frames %d and %d: %s", a.frame, b.frame, record.verdict)


def _end(place: Place, prediction: Prediction, colors: Image) -> End:
    return End(
        place.window, prediction, colors, int(np.searchsorted(prediction.frames, place.frame))
    )
