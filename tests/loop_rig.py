"""A drive in circles whose places are known and whose candidates are measured at will."""

import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from ring import LAP, NUM_WINDOWS, SIZE, Drift, prediction_of, true_link

import laser_slam.slam.loops
from laser_slam.closures import CandidateEnds, ClosureRecord, Judged, Measurement, Tools
from laser_slam.config import Config
from laser_slam.places import CandidateSearch, Place
from laser_slam.sim3 import Sim3
from laser_slam.slam import LoopCloser, Slam
from laser_slam.store import WindowFiles
from laser_slam.types import Image, Prediction

DRIFT = Drift(seed=1)


def marked(frames: NDArray[np.int64]) -> Image:
    """Make images that say which frame they are."""
    images = np.zeros((len(frames), *SIZE, 3), np.uint8)
    images[:] = frames[:, None, None, None]
    return images


def frame_in(image: Image) -> int:
    return int(np.rint(image.mean()))


class Marks:
    """Describes each place of the lap by a vector of its own, and notes what it was shown."""

    size = 256

    def __init__(self) -> None:
        self.seen: list[int] = []

    def describe(self, image: Image) -> NDArray[np.float32]:
        self.seen.append(frame_in(image))
        vector = np.random.default_rng(self.seen[-1] % LAP).normal(size=self.size)
        return np.asarray(vector / np.linalg.norm(vector), np.float32)


class Search(CandidateSearch):
    """Notes the places that it was given."""

    given: list[Place]

    def add(self, places, descriptors):  # type: ignore[no-untyped-def]
        self.given = [*getattr(self, "given", []), *places]
        return super().add(places, descriptors)


class Files(WindowFiles):
    """Notes the windows that were read, and which of them are still in memory."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.read: list[int] = []
        self.alive: list[weakref.ref[Prediction]] = []

    def load(self, index: int, frames: NDArray[np.int64] | None = None) -> tuple[Prediction, Image]:
        self.read.append(index)
        prediction, colors = super().load(index, frames)
        self.alive.append(weakref.ref(prediction))
        return prediction, colors


Verdict = Callable[[CandidateEnds], Sim3 | str]


def truth(ends: CandidateEnds) -> Sim3 | str:
    """Measure every candidate as it is."""
    return true_link(ends.a.window, ends.b.window, DRIFT.seed)[0]


class Rig:
    """A drive whose places are known and whose candidates are measured as a test wants it."""

    def __init__(
        self, tmp_path: Path, patch: pytest.MonkeyPatch, verdict: Verdict = truth,
        config: Config | None = None,
    ) -> None:  # fmt: skip
        self.verdict = verdict
        self.chain_scales: list[float] = []
        self.shown: list[tuple[int, int]] = []
        self.num_alive = [0]
        self.marks = Marks()
        patch.setattr(laser_slam.slam.loops, "make_descriptor", lambda _: self.marks)
        patch.setattr(laser_slam.slam.loops, "CandidateSearch", Search)
        patch.setattr(laser_slam.slam.loops, "judge", self.judge)
        self.config = config or Config()
        for name in ("windows", "layers"):
            (tmp_path / name).mkdir(parents=True)
        self.slam, self.files = Slam(self.config), Files(tmp_path)
        self.closer = LoopCloser(self.config, self.slam, self.files, Tools(lambda *_: None))  # type: ignore[arg-type, return-value]

    @property
    def given(self) -> list[Place]:
        search = self.closer._search
        assert isinstance(search, Search)
        return search.given

    @property
    def verdicts(self) -> list[str]:
        return [record.verdict for record in self.closer.records]

    def drive(self, num: int = NUM_WINDOWS, see: Callable[[int], Prediction] | None = None) -> None:
        """Add windows, as a run does, but for the last look."""
        for window in range(num):
            prediction = see(window) if see else prediction_of(window, DRIFT)
            self.add(prediction)

    def add(self, prediction: Prediction) -> None:
        colors = marked(prediction.frames)
        self.files.save(len(self.slam.nodes), prediction, colors)
        self.files.alive.append(weakref.ref(prediction))
        submap = self.slam.add(prediction, colors)
        if self.slam.layers is not None:
            self.files.save_layers(submap.index, self.slam.layers)
        self.closer.add(submap.prediction, colors)

    def judge(self, ends: CandidateEnds, _tools: Tools, _config: Config) -> Judged:
        a, b = ends.a, ends.b
        self.num_alive.append(sum(ref() is not None for ref in self.files.alive))
        self.chain_scales.append(ends.chain_scale)
        self.shown.append((frame_in(a.colors[a.matched]), frame_in(b.colors[b.matched])))
        found = self.verdict(ends)
        measured = None
        if isinstance(found, Sim3):
            sigmas = true_link(a.window, b.window, DRIFT.seed)[1]
            measured = Measurement(found, np.diag(sigmas**2), 99, 99, 0.01, "truth")
        words = "accepted" if measured else str(found)
        return Judged(
            ClosureRecord(a.window, b.window, a.frame, b.frame, ends.similarity, words), measured
        )
