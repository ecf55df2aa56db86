"""A rendered drive around a block, seen by simulated networks: a run closes its loop."""

from collections.abc import Generator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import laser_slam.pipeline
from laser_slam.backbones import make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.closures import ClosureRecord, read_closures
from laser_slam.config import Config, SyntheticConfig, load_config
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.pipeline import Pipeline
from laser_slam.results import Results, fuse_run
from laser_slam.store import TileFiles
from laser_slam.types import Frame, Image, Prediction, SequenceInfo, Submap

SETTINGS = [
    "backbone.name=simulated", "backbone.simulated.width=322", "windows.size=10",
    "windows.overlap=4", "windows.min_parallax_px=0", "layers.enabled=never", "fusion.stride=4",
    "run.samples=1",
]  # fmt: skip
CONFIG = load_config(assignments=SETTINGS)
NEAR_M, SAME_WAY_DEG = 8.0, 30.0  # one view of the street; it is 130 m around the block


class Drive:
    """Rendered once, read several times."""

    def __init__(self, num_frames: int, step_m: float) -> None:
        drive = SyntheticDrive(
            SyntheticConfig(num_frames=num_frames, step_m=step_m, width=322, height=98)
        )
        self.info: SequenceInfo = drive.info
        self._frames = list(drive.frames())
        self._depth = [drive.true_depth(frame) for frame in range(num_frames)]

    def frames(self) -> Generator[Frame, None, None]:
        yield from self._frames

    def true_depth(self, frame: int) -> NDArray[np.float32] | None:
        return self._depth[frame].copy()

    def apart(self, record: ClosureRecord) -> tuple[float, float]:
        """Return metres and degrees between the two frames of a candidate."""
        assert self.info.truth is not None
        poses = self.info.truth.world_from_cam
        a_from_b = np.linalg.inv(poses[record.frame_a]) @ poses[record.frame_b]
        angle = np.degrees(np.arccos(np.clip((np.trace(a_from_b[:3, :3]) - 1) / 2, -1, 1)))
        return float(np.linalg.norm(a_from_b[:3, 3])), float(angle)


@dataclass
class Answers:
    """What the simulated network said of each set of frames, so that it need not be asked again."""

    known: dict[tuple[int, ...], Prediction] = field(default_factory=dict)


class Network:
    """The simulated backbone, which may be broken off and counts its windows."""

    remembers = False
    sees_far_frames = True

    def __init__(self, drive: Drive, answers: Answers, interrupt_at: int | None = None) -> None:
        self._real: Backbone = make_backbone(CONFIG.backbone, drive.info, drive.true_depth)
        self._answers, self._interrupt_at = answers, interrupt_at
        self.intrinsics: list[NDArray[np.float64] | None] = []
        self.image_size, self.calibrate = self._real.image_size, self._real.calibrate
        self.identity = self._real.identity

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        if len(self.intrinsics) == self._interrupt_at:
            raise KeyboardInterrupt
        self.intrinsics.append(intrinsics)
        key = tuple(int(frame) for frame in frames)
        if key not in self._answers.known:
            self._answers.known[key] = self._real.predict(images, frames, intrinsics)
        return self._answers.known[key]


@dataclass(frozen=True)
class Run:
    """What a run left."""

    results: Results
    records: list[ClosureRecord]
    network: Network
    fused_at: dict[int, NDArray[np.float64]]

    @property
    def ate_m(self) -> float:
        return float(self.results.report["trajectory"]["ate_sim3_m"]["rmse"])

    @property
    def num_windows(self) -> int:
        return int(self.results.report["windows"]["num"])


class World:
    """The drive and all that was run on it."""

    def __init__(self, drive: Drive) -> None:
        self.drive, self.answers = drive, Answers()

    def run(self, folder: Path, config: Config = CONFIG, interrupt_at: int | None = None) -> Run:
        network = Network(self.drive, self.answers, interrupt_at)
        fused_at: dict[int, NDArray[np.float64]] = {}

        def fuse_noting(*arguments: Any) -> TileFiles:
            *others, see = arguments

            def note(submap: Submap) -> None:
                for i in np.flatnonzero(submap.is_owned):
                    pose = submap.places[i].apply_poses(submap.prediction.window_from_cam[i])
                    fused_at[int(submap.prediction.frames[i])] = pose
                see(submap)

            return fuse_run(*others, note)

        with pytest.MonkeyPatch.context() as patch:
            for name in dir(laser_slam.pipeline):
                if name.startswith("draw_") or name == "stages_picture":
                    patch.setattr(laser_slam.pipeline, name, lambda *_: None)
            patch.setattr(laser_slam.pipeline, "fuse_run", fuse_noting)
            results = Pipeline(self.drive, config, folder, backbone=network).run()
        path = folder / "closures.json"
        return Run(results, read_closures(path) if path.exists() else [], network, fused_at)


@pytest.fixture(scope="module")
def world() -> World:
    return World(Drive(100, 1.6))


@pytest.fixture(scope="module")
def whole(world: World, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return world.run(tmp_path_factory.mktemp("runs") / "whole")


@pytest.fixture(scope="module")
def without(world: World, tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = load_config(assignments=[*SETTINGS, "closures.enabled=false"])
    return world.run(tmp_path_factory.mktemp("runs") / "without", config)


def test_a_run_closes_its_loop_and_comes_nearer_to_the_truth(whole: Run, without: Run) -> None:
    assert any(record.is_accepted for record in whole.records)
    assert whole.ate_m < 0.7 * without.ate_m
    assert max(record.window_b for record in whole.records) == whole.num_windows - 1


def test_the_map_is_fused_where_the_trajectory_is(whole: Run) -> None:
    trajectory = whole.results.trajectory
    assert sorted(whole.fused_at) == trajectory.frames.tolist()
    fused_at = [whole.fused_at[int(frame)] for frame in trajectory.frames]
    assert np.allclose(fused_at, trajectory.world_from_cam, atol=1e-9)


def test_every_closure_joins_frames_that_are_near_and_look_the_same_way(
    whole: Run, world: World
) -> None:
    for record in whole.records:
        metres, degrees = world.drive.apart(record)
        if record.is_accepted:
            assert metres < NEAR_M
            assert degrees < SAME_WAY_DEG


def test_without_closures_nothing_is_looked_at_and_the_chain_is_the_result(
    without: Run, whole: Run
) -> None:
    assert without.records == []
    assert len(without.network.intrinsics) == without.num_windows
    assert len(whole.network.intrinsics) > whole.num_windows
    assert "places" not in without.results.report["seconds"]["wall"]


def test_windows_of_both_ends_are_seen_by_the_same_camera(whole: Run) -> None:
    given = [intrinsics for intrinsics in whole.network.intrinsics if intrinsics is not None]
    assert len(given) == len(whole.network.intrinsics)
    assert np.ptp(given, axis=0).max() == 0


@pytest.mark.parametrize("is_late", [False, True])
def test_a_broken_off_run_closes_the_same_loops_as_a_whole_one(
    world: World, whole: Run, tmp_path: Path, is_late: bool
) -> None:
    """Early: before there is a loop. Late: a window after the last but one of both ends."""
    at = len(whole.network.intrinsics) - 1 if is_late else 6
    with pytest.raises(KeyboardInterrupt):
        world.run(tmp_path / "run", interrupt_at=at)
    again = world.run(tmp_path / "run")
    assert len(again.network.intrinsics) < len(whole.network.intrinsics)
    assert len(again.records) == len(whole.records) > 3
    for record, expected in zip(again.records, whole.records, strict=True):
        for name, value in asdict(expected).items():
            is_measured = isinstance(value, float)  # sums over threads are not quite the same
            assert getattr(record, name) == (pytest.approx(value) if is_measured else value)
    poses = [run.results.trajectory.world_from_cam for run in (again, whole)]
    assert np.allclose(*poses, atol=1e-6)
