"""Predict once, map anywhere: the same map without an image; what does not fit is refused."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from corridor import Corridor, TrueBackbone
from numpy.typing import NDArray
from quick_runs import leave_pictures_out
from typer.testing import CliRunner

from laser_slam.bookkeeping import StageClock
from laser_slam.cli import app
from laser_slam.config import Config, load_config
from laser_slam.errors import ConfigError, LaserSlamError, RunFolderError
from laser_slam.pipeline import Pipeline
from laser_slam.predicting import Job
from laser_slam.predicting.ahead import ahead
from laser_slam.predicting.sequence import PredictedSequence
from laser_slam.results import Results
from laser_slam.store import WindowFiles

NUM_FRAMES = 24
SETTINGS = ["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"]
CONFIG = load_config(assignments=SETTINGS)
WHOLE = """backbone: x
identity: {a: 1}
image_size: [3, 4]
settings: {windows: {}}
windows: [[0]]
"""
MADE = ("trajectory_kitti.txt", "map.ply", "graph.g2o")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_pictures_out(monkeypatch)


@pytest.fixture(scope="module")
def predicted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Predict the corridor once, with two frames that cannot be read."""
    folder = tmp_path_factory.mktemp("predicted") / "corridor"
    dataset = Corridor(NUM_FRAMES, unreadable=(4, 5))
    assert Job(dataset, CONFIG, folder, backbone=TrueBackbone()).run() == 4
    return folder


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Map the same at once."""
    folder = tmp_path_factory.mktemp("mapped") / "run"
    dataset = Corridor(NUM_FRAMES, unreadable=(4, 5))
    Pipeline(dataset, CONFIG, folder, backbone=TrueBackbone()).run()
    return folder


def replaying(folder: Path, *assignments: str) -> Config:
    names = [*SETTINGS, "backbone.name=replay", f"backbone.replay.folder={folder}", *assignments]
    return load_config(assignments=names)


def replay(predictions: Path, out: Path, *assignments: str) -> Results:
    """Map what was predicted, from its folder alone."""
    sequence = PredictedSequence(predictions)
    config = load_config(assignments=assignments, base=sequence.settings)
    return Pipeline(sequence, config, out).run()


def refusal(work: Any, *arguments: Any, kind: type[LaserSlamError] = RunFolderError) -> str:
    with pytest.raises(kind) as caught:
        work(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_predicting_leaves_windows_and_no_map(predicted: Path) -> None:
    names = {str(path.relative_to(predicted)) for path in predicted.rglob("*") if path.is_file()}
    windows = {f"windows/{index:06d}.npz" for index in range(4)}
    about = {"predictions.yaml", "frames.npz", "sequence.yaml", "config.yaml", "calibration.yaml"}
    assert names == windows | about | {"run.log", "truth_tum.txt"}


def test_the_manifest_tells_backbone_preprocessing_and_windows(predicted: Path) -> None:
    manifest = yaml.safe_load((predicted / "predictions.yaml").read_text())
    assert manifest["backbone"] == "classical"
    assert manifest["identity"] == {"corridor": 1}
    assert manifest["image_size"] == list(Corridor(1).info.size)
    assert manifest["settings"]["windows"]["size"] == 8
    assert manifest["windows"][0] == [0, 1, 2, 3, 6, 7, 8, 9]
    assert manifest["windows"][-1][-1] == NUM_FRAMES - 1


def test_a_map_from_predictions_is_the_map_made_at_once(
    predicted: Path, mapped: Path, tmp_path: Path
) -> None:
    results = replay(predicted, tmp_path / "replayed")
    for name in MADE:
        assert (results.folder / name).read_bytes() == (mapped / name).read_bytes()
    assert results.report["frames"] == {"read": NUM_FRAMES, "unreadable": 2, "keyframes": 22}
    assert results.report["trajectory"]["ate_sim3_m"]["rmse"] < 2e-3


def test_a_run_can_be_replayed_as_well(mapped: Path, tmp_path: Path) -> None:
    results = replay(mapped, tmp_path / "again")
    for name in MADE:
        assert (results.folder / name).read_bytes() == (mapped / name).read_bytes()


def test_other_settings_make_another_map_of_the_same_predictions(
    predicted: Path, tmp_path: Path
) -> None:
    coarse = replay(predicted, tmp_path / "coarse", "fusion.voxel_size=0.5")
    fine = replay(predicted, tmp_path / "fine", "fusion.voxel_size=0.1")
    assert 0 < len(coarse.cloud.points) < len(fine.cloud.points)


def test_predictions_are_mapped_with_the_data_set_at_hand_too(
    predicted: Path, mapped: Path, tmp_path: Path
) -> None:
    dataset = Corridor(NUM_FRAMES, unreadable=(4, 5))
    results = Pipeline(dataset, replaying(predicted), tmp_path / "run").run()
    assert (results.folder / MADE[0]).read_bytes() == (mapped / MADE[0]).read_bytes()
    assert results.report["depth"] is not None


def test_layers_are_chosen_by_the_backbone_that_predicted(predicted: Path, tmp_path: Path) -> None:
    def origin(name: str) -> Results:
        folder = tmp_path / name
        shutil.copytree(predicted, folder)
        text = (folder / "predictions.yaml").read_text()
        text = text.replace("backbone: classical", f"backbone: {name}")
        (folder / "predictions.yaml").write_text(text)
        return replay(folder, tmp_path / f"run-{name}")

    assert origin("classical").report["layers"] is None
    assert origin("pi3").report["layers"] is not None


def test_the_original_is_untouched(predicted: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in predicted.rglob("*") if path.is_file()}
    replay(predicted, tmp_path / "run", "layers.enabled=always")
    assert before == {path: path.read_bytes() for path in predicted.rglob("*") if path.is_file()}


def test_mapping_goes_on_where_predicting_ended(tmp_path: Path, mapped: Path) -> None:
    dataset, folder = Corridor(NUM_FRAMES, unreadable=(4, 5)), tmp_path / "run"
    Job(dataset, CONFIG, folder, backbone=TrueBackbone()).run()
    backbone = TrueBackbone(remembers=True)
    Pipeline(dataset, CONFIG, folder, backbone=backbone).run()
    assert backbone.calls == 0
    assert (folder / MADE[0]).read_bytes() == (mapped / MADE[0]).read_bytes()


def test_predicting_goes_on_where_it_was_broken_off(tmp_path: Path, predicted: Path) -> None:
    dataset, folder = Corridor(NUM_FRAMES, unreadable=(4, 5)), tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt):
        Job(dataset, CONFIG, folder, backbone=TrueBackbone(interrupt_at=2)).run()
    assert "does not hold all predictions" in refusal(PredictedSequence, folder)
    backbone = TrueBackbone()
    assert Job(dataset, CONFIG, folder, backbone=backbone).run() == 4
    assert backbone.calls == 2
    for path in (predicted / "windows").iterdir():
        assert (folder / "windows" / path.name).read_bytes() == path.read_bytes()


def test_another_backbone_does_not_go_on_with_the_predictions_of_one(tmp_path: Path) -> None:
    class Other(TrueBackbone):
        def identity(self) -> dict[str, Any]:
            return {"corridor": 2}

    dataset, folder = Corridor(NUM_FRAMES), tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt):
        Job(dataset, CONFIG, folder, backbone=TrueBackbone(interrupt_at=2)).run()
    message = refusal(Job(dataset, CONFIG, folder, backbone=Other()).run)
    assert "other means: identity.corridor (1, now 2); predict anew" in message


def test_predictions_of_other_windows_are_refused_by_the_setting(
    predicted: Path, tmp_path: Path
) -> None:
    config = replaying(predicted, "windows.overlap=4")
    dataset = Corridor(NUM_FRAMES, unreadable=(4, 5))
    message = refusal(Pipeline, dataset, config, tmp_path / "run")
    assert "other settings: windows.overlap (3, now 4)" in message
    assert f"--config {predicted / 'config.yaml'} takes theirs" in message
    assert not (tmp_path / "run").exists()


def test_predictions_of_another_input_are_refused(predicted: Path, tmp_path: Path) -> None:
    pipeline = Pipeline(Corridor(NUM_FRAMES + 1), replaying(predicted), tmp_path / "run")
    assert f"num_frames ({NUM_FRAMES}, now {NUM_FRAMES + 1})" in refusal(pipeline.run)
    assert not (tmp_path / "run").exists()


def test_predictions_are_not_mapped_into_their_own_folder(predicted: Path) -> None:
    sequence = PredictedSequence(predicted)
    pipeline = Pipeline(sequence, load_config(base=sequence.settings), predicted)
    assert "choose another with --out" in refusal(pipeline.run)


@pytest.mark.parametrize("content", [None, b"cut off"])
def test_a_lost_or_damaged_window_is_named_where_it_is_to_be_mended(
    predicted: Path, tmp_path: Path, content: bytes | None
) -> None:
    shutil.copytree(predicted, tmp_path / "lost")
    path = tmp_path / "lost" / "windows" / "000002.npz"
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    assert f"cannot read window file {path}" in refusal(replay, tmp_path / "lost", tmp_path / "run")


def test_a_window_that_is_lost_is_predicted_again(tmp_path: Path) -> None:
    dataset, folder = Corridor(NUM_FRAMES), tmp_path / "lost"
    Job(dataset, CONFIG, folder, backbone=TrueBackbone()).run()
    before = (folder / "windows" / "000001.npz").read_bytes()
    (folder / "windows" / "000001.npz").unlink()
    backbone = TrueBackbone()
    Job(dataset, CONFIG, folder, backbone=backbone).run()
    assert backbone.calls == 1
    assert (folder / "windows" / "000001.npz").read_bytes() == before


def test_a_replay_does_not_go_on_with_predictions_of_another_backbone(
    predicted: Path, tmp_path: Path
) -> None:
    origin = tmp_path / "origin"
    shutil.copytree(predicted, origin)
    config = load_config(base=PredictedSequence(origin).settings)
    replay(origin, tmp_path / "run")
    (tmp_path / "run" / "report.json").unlink()
    text = (origin / "predictions.yaml").read_text()
    (origin / "predictions.yaml").write_text(text.replace("corridor: 1", "corridor: 2"))
    message = refusal(Pipeline(PredictedSequence(origin), config, tmp_path / "run").run)
    assert "other means: identity.corridor (1, now 2)" in message


def test_a_replay_takes_the_size_of_windows_that_were_predicted(
    predicted: Path, tmp_path: Path
) -> None:
    results = replay(predicted, tmp_path / "run", "windows.size=auto")
    assert results.report["settings"]["windows"]["size"] == 8


def test_a_backbone_waits_for_neither_the_use_nor_the_storing_of_its_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_store, backbone = threading.Event(), TrueBackbone()
    save = WindowFiles.save

    def wait_then_save(files: WindowFiles, *arguments: Any) -> Any:
        assert may_store.wait(20)
        return save(files, *arguments)

    def wait_for(num_calls: int) -> None:
        deadline = time.monotonic() + 20
        while backbone.calls < num_calls and time.monotonic() < deadline:
            time.sleep(0.001)
        assert backbone.calls >= num_calls

    monkeypatch.setattr(WindowFiles, "save", wait_then_save)
    source = Job(Corridor(40), CONFIG, tmp_path / "run", backbone=backbone).source
    source.open()
    source.calibrate()
    with closing(source.windows()) as windows, ThreadPoolExecutor() as pool:
        first = pool.submit(next, windows)
        wait_for(2)  # while the first is not stored
        may_store.set()
        first.result()
        wait_for(4)  # while the first is in use


def test_a_window_of_other_frames_is_refused(predicted: Path, tmp_path: Path) -> None:
    windows = tmp_path / "swapped" / "windows"
    shutil.copytree(predicted, windows.parent)
    shutil.copy(windows / "000001.npz", windows / "000002.npz")
    message = refusal(replay, windows.parent, tmp_path / "run")
    assert "holds other frames than window 2" in message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("predictions.yaml", "a: ["),
        ("predictions.yaml", "just words"),
        ("predictions.yaml", "image_size: [3, 4]\nbackbone: x"),
        ("predictions.yaml", WHOLE.replace("[[0]]", "3")),
        ("predictions.yaml", WHOLE.replace("[[0]]", "[]")),
        ("predictions.yaml", WHOLE.replace("{windows: {}}", "[1]")),
        ("predictions.yaml", WHOLE.replace("{a: 1}", "null")),
        ("sequence.yaml", "size: 3"),
        ("sequence.yaml", ""),
        ("frames.npz", "no archive"),
    ],
)
def test_a_damaged_file_is_named(predicted: Path, tmp_path: Path, name: str, content: str) -> None:
    shutil.copytree(predicted, tmp_path / "damaged")
    (tmp_path / "damaged" / name).write_text(content)
    message = refusal(PredictedSequence, tmp_path / "damaged")
    assert name in message
    assert "damaged" in message


def test_a_folder_without_predictions_is_refused(tmp_path: Path) -> None:
    message = refusal(PredictedSequence, tmp_path / "nothing")
    assert "no predictions in" in message
    assert "laser-slam predict" in message


def test_replaying_needs_a_folder_and_predicts_nothing(tmp_path: Path) -> None:
    config = load_config(assignments=["backbone.name=replay"])
    message = refusal(Pipeline, Corridor(8), config, tmp_path / "run", kind=ConfigError)
    assert "backbone.replay.folder: not set" in message
    message = refusal(Job, Corridor(8), config, tmp_path / "run", kind=ConfigError)
    assert "name a backbone" in message


def test_the_size_of_windows_is_settled_before_the_run(tmp_path: Path) -> None:
    config = load_config(assignments=["windows.size=auto", *SETTINGS[1:]])
    Job(Corridor(NUM_FRAMES), config, tmp_path / "auto", backbone=TrueBackbone()).run()
    settled = load_config(file=tmp_path / "auto" / "config.yaml").windows.size
    assert 3 < settled <= 75
    again = Job(Corridor(NUM_FRAMES), config, tmp_path / "auto", backbone=TrueBackbone())
    assert again.run() == len(list((tmp_path / "auto" / "windows").iterdir()))


def test_the_command_line_predicts_and_replays(tmp_path: Path) -> None:
    small = ["--set", "synthetic.num_frames=24", "--set", "synthetic.width=160"]
    small += ["--set", "synthetic.height=64", "--set", "windows.size=8", "--quiet"]
    simulated = ["--backbone", "simulated", "--set", "windows.min_parallax_px=0.1"]

    def said(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exit_code == 0, result.output
        return result.stdout

    out = tmp_path / "predictions"
    assert f"laser-slam replay {out}" in said("predict", "demo", *small, *simulated, "--out", out)
    text = said("replay", out, "--quiet", "--out", tmp_path / "map", "--set",
                "closures.enabled=false")  # fmt: skip
    assert "ATE (Sim(3))" in text
    result = CliRunner().invoke(app, ["replay", str(out), "--backbone", "pi3"])
    assert result.exit_code == 1
    assert "predicted already" in result.stderr


def test_items_come_in_order_and_are_made_before_they_are_asked_for() -> None:
    made: list[int] = []

    def items() -> Iterator[int]:
        for item in range(5):
            made.append(item)
            yield item

    with closing(ahead(items())) as taken:
        assert next(taken) == 0
        deadline = time.monotonic() + 5
        while len(made) < 3 and time.monotonic() < deadline:
            time.sleep(0.001)
        assert made == [0, 1, 2]  # one is kept, one waits to be
        assert list(taken) == [1, 2, 3, 4]


def test_what_goes_wrong_ahead_is_raised_where_the_item_is_asked_for() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise KeyboardInterrupt

    taken = ahead(items())
    assert next(taken) == 1
    with pytest.raises(KeyboardInterrupt):
        next(taken)


def test_closing_ends_the_thread_and_what_it_reads() -> None:
    is_closed = threading.Event()

    def items() -> Iterator[int]:
        try:
            while True:
                yield 1
        finally:
            is_closed.set()

    before = threading.active_count()
    taken = ahead(items())
    next(taken)
    taken.close()
    assert is_closed.is_set()
    assert threading.active_count() == before


def test_stages_of_several_threads_share_the_time_and_sum_up_to_it() -> None:
    clock = StageClock()
    start = time.perf_counter()

    def items() -> Iterator[NDArray[np.float64]]:
        for _ in range(5):
            with clock.stage("make"):
                time.sleep(0.01)
            yield np.zeros(1)

    for _ in ahead(items(), clock.idle):
        with clock.stage("use"):
            time.sleep(0.02)
    report = clock.report(5)["seconds"]
    assert report["wall_in_all"] == pytest.approx(time.perf_counter() - start, abs=0.02)
    assert report["wall_in_all"] == pytest.approx(sum(report["wall"].values()), abs=0.01)
    assert report["wall"]["use"] > report["wall"]["make"] > 0.01
