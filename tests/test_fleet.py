"""Workers of Ray predict what one process predicts, also when one of them dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from laser_slam.cli import app
from laser_slam.config import Config, load_config
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.errors import ConfigError, LaserSlamError, WeightsError
from laser_slam.predicting import Fleet, Job
from laser_slam.predicting.cluster import divide
from laser_slam.predicting.fleet import Crew, _cause, _Task
from laser_slam.store import load_prediction
from laser_slam.types import Window

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'laser-slam[ray]'")

NUM_FRAMES = 40
SMALL = ["synthetic.width=192", "synthetic.height=96", f"synthetic.num_frames={NUM_FRAMES}"]
SMALL += ["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.5"]
CONFIG = load_config(assignments=[*SMALL, "calibration.keyframes=0"])
ONE, TWO = Fleet(num_workers=1, cores=1), Fleet(num_workers=2, cores=1)


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """Start Ray once for all tests that need it."""
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture(autouse=True)
def short_stretches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a few frames be several stretches."""
    for module in ("fleet", "job"):
        monkeypatch.setattr(f"laser_slam.predicting.{module}.STRETCH", 2)


def job(folder: Path, config: Config = CONFIG, fleet: Fleet | None = TWO, **more: Any) -> Job:
    return Job(SyntheticDrive(config.synthetic), config, folder, fleet=fleet, **more)


def begin(folder: Path) -> None:
    """Leave the folder of a job of a fleet that had nothing done yet."""
    source = job(folder).source
    source.leave_to_others({**source.backbone.identity(), "stretch": 2})
    source.open()


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, cluster: None) -> dict[str, bytes]:
    """Predict stretch by stretch in one process: what any fleet must leave."""
    source = job(tmp_path_factory.mktemp("alone") / "windows").source
    source.open()
    windows = list(source.cut())
    with Crew(ONE, CONFIG.backbone) as crew:
        stretches = [windows[first : first + 2] for first in range(0, len(windows), 2)]
        done = crew.predict(stretches, source.rectifier.intrinsics)
        files = sorted((stretch[0].index, contents) for stretch, contents in done)
    in_order = [content for _, contents in files for content in contents]
    return {f"{index:06d}.npz": content for index, content in enumerate(in_order)}


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "windows").iterdir()}


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path) -> None:
    work = job(tmp_path / "run", fleet=Fleet(address="127.0.0.1:1"))
    with pytest.raises(ConfigError, match=r"--address: nothing answers at 127\.0\.0\.1:1"):
        work.run()


@pytest.mark.usefixtures("cluster")
def test_two_workers_leave_what_one_process_leaves(tmp_path: Path, alone: dict[str, bytes]) -> None:
    seen: list[int] = []
    work = job(tmp_path / "run", on_progress=lambda _stage, done, _total: seen.append(done))
    assert work.run() == len(alone) > 6
    assert files_of(tmp_path / "run") == alone
    assert max(seen) == NUM_FRAMES
    assert seen[0] == 0
    assert len(seen) == 1 + len(alone)
    prediction, _ = load_prediction(tmp_path / "run" / "windows" / "000003.npz")
    assert prediction.confidence.any()


@pytest.mark.usefixtures("cluster")
def test_a_worker_that_is_killed_leaves_no_gap(
    tmp_path: Path, alone: dict[str, bytes], monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    killed: list[int] = []
    give = Crew._give

    def kill_the_first(crew: Crew, *arguments: Any) -> None:
        pid = None if killed else ray.get(crew.workers[0].process.remote())
        give(crew, *arguments)
        if pid is not None:
            killed.append(pid)
            os.kill(pid, signal.SIGKILL)

    monkeypatch.setattr(Crew, "_give", kill_the_first)
    assert job(tmp_path / "run").run() == len(alone)
    assert killed
    assert files_of(tmp_path / "run") == alone
    assert "a worker was lost; windows" in caplog.text


@pytest.mark.usefixtures("cluster")
def test_a_job_that_was_broken_off_goes_on_with_what_is_missing(
    tmp_path: Path, alone: dict[str, bytes]
) -> None:
    folder = tmp_path / "run"
    begin(folder)
    kept = {"000000.npz": b"kept", "000001.npz": b"kept", "000002.npz": b"half a stretch"}
    for name, content in kept.items():
        (folder / "windows" / name).write_bytes(content)
    assert job(folder).run() == len(alone)
    del kept["000002.npz"]  # its stretch is done again, for the backbone remembers
    assert files_of(folder) == alone | kept


def test_what_a_fleet_began_is_not_gone_on_with_alone(tmp_path: Path) -> None:
    begin(tmp_path / "run")
    with pytest.raises(LaserSlamError, match=r"identity.stretch \(2, now None\)"):
        job(tmp_path / "run", fleet=None).run()


@pytest.mark.usefixtures("cluster")
def test_an_error_of_a_worker_comes_as_it_is(tmp_path: Path) -> None:
    missing = ["backbone.name=pi3", f"backbone.pi3.weights={tmp_path / 'gone.pt'}"]
    config = load_config(assignments=missing).backbone
    with pytest.raises(WeightsError, match="no file"), Crew(ONE, config):
        pass


@pytest.mark.usefixtures("cluster")
def test_a_worker_with_another_backbone_is_refused() -> None:
    crew = Crew(ONE, CONFIG.backbone)
    crew.identity = {**CONFIG.backbone.classical.model_dump(), "num_planes": 7}
    with pytest.raises(ConfigError, match=r"num_planes \(7, now 64\); give all machines the same"):
        crew.__enter__()


def test_the_size_of_windows_is_not_left_to_the_machine_that_does_not_predict(
    tmp_path: Path,
) -> None:
    config = load_config(assignments=[*SMALL, "windows.size=auto"])
    with pytest.raises(ConfigError, match="give the workers a number"):
        job(tmp_path / "run", config)


def test_a_machine_without_the_workers_device_can_lead_them(tmp_path: Path) -> None:
    weights = tmp_path / "pi3.safetensors"
    weights.write_bytes(b"read when the first window is predicted")
    names = [f"backbone.pi3.weights={weights}", "backbone.pi3.device=cuda:7"]
    config = load_config(assignments=[*SMALL, "backbone.name=pi3", *names])
    lead = job(tmp_path / "run", config).source
    assert lead.backbone is not None
    assert lead.backbone.image_size((376, 1241)) == (154, 518)


def test_the_simulated_backbone_is_not_spread(tmp_path: Path) -> None:
    config = load_config(assignments=[*SMALL, "backbone.name=simulated"])
    with pytest.raises(ConfigError, match="predict without --engine"):
        job(tmp_path / "run", config)


@pytest.mark.parametrize(
    ("has", "fleet", "name", "wanted"),
    [
        ([{"CPU": 64, "GPU": 8}], Fleet(), "pi3", (8, 8, 1)),
        ([{"CPU": 64, "GPU": 8}], Fleet(num_workers=3, cores=4), "vggt", (3, 4, 1)),
        ([{"CPU": 64, "GPU": 8}], Fleet(), "classical", (32, 2, 0)),
        ([{"CPU": 4}, {"CPU": 2, "GPU": 1}], Fleet(), "pi3", (1, 2, 1)),
        ([{"CPU": 3}, {"CPU": 3}], Fleet(), "classical", (2, 2, 0)),
        ([{"CPU": 6}], Fleet(cores=3), "pi3", (2, 3, 0)),
        ([{"CPU": 1}], Fleet(), "classical", (1, 1, 0)),
    ],
)
def test_workers_fill_the_cluster(
    has: list[dict[str, float]], fleet: Fleet, name: str, wanted: tuple[int, int, int]
) -> None:
    config = load_config(assignments=[f"backbone.name={name}"]).backbone
    needs, num = divide(has, fleet, config)
    assert (num, needs["num_cpus"], needs["num_gpus"]) == wanted


def test_more_workers_than_there_is_room_for_are_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"5 workers of 1 cores .* room for 4 on 1 machines; lower"
    ):
        divide([{"CPU": 4}], Fleet(num_workers=5, cores=1), CONFIG.backbone)


@pytest.mark.usefixtures("cluster")
def test_a_crew_goes_on_with_those_who_are_left(
    tmp_path: Path, alone: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a machine is gone: nobody comes in the place of the one that is lost."""
    give, start, killed = Crew._give, Crew._start, []

    def start_no_third(crew: Crew) -> None:
        if not killed:
            start(crew)

    def kill_the_first(crew: Crew, *arguments: Any) -> None:
        give(crew, *arguments)
        if not killed:
            killed.append(crew.workers[0])
            ray.kill(crew.workers[0])

    monkeypatch.setattr(Crew, "_start", start_no_third)
    monkeypatch.setattr(Crew, "_give", kill_the_first)
    assert job(tmp_path / "run").run() == len(alone)
    assert files_of(tmp_path / "run") == alone


@pytest.mark.usefixtures("cluster")
def test_windows_over_which_every_worker_is_lost_end_the_job() -> None:
    with Crew(ONE, CONFIG.backbone) as crew:
        task = _Task([Window(4, np.arange(2), ())])
        for _ in range(2):
            crew._let_go(None, task, RuntimeError("gone"))
        with pytest.raises(LaserSlamError, match=r"3 workers were lost over windows 4 to 4 \(gone"):
            crew._let_go(None, task, RuntimeError("gone"))


def test_options_of_a_fleet_without_a_fleet_are_refused() -> None:
    result = CliRunner().invoke(app, ["predict", "demo", "--workers", "2"])
    assert result.exit_code == 1
    assert "are for --engine ray" in result.stderr


def test_a_bug_in_a_worker_is_told_in_one_line() -> None:
    error = _cause(RuntimeError("a traceback\nZeroDivisionError: a bug\n"))
    assert str(error) == "a worker failed: ZeroDivisionError: a bug; see Ray's log"
