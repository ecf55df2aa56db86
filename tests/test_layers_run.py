"""Layers over many windows and in whole runs: the second pass, files, resumption, report."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import Boards, Window
from corridor import Corridor, TrueBackbone
from numpy.typing import NDArray
from quick_runs import leave_pictures_out

import laser_slam.pipeline
from laser_slam.config import Config, LayersConfig, SegmentationConfig, load_config
from laser_slam.layers import align_layers, apply_layers, first_layers, smooth_layers
from laser_slam.pipeline import Pipeline
from laser_slam.results import Results
from laser_slam.store import WindowFiles, load_layers
from laser_slam.types import Image, Layers, Prediction, WindowStatus

Array = NDArray[np.float64]
NUM_WINDOWS, NUM, STEP = 6, 6, 3

# --- the second pass ----------------------------------------------------------------------------


@dataclass
class Chain:
    """Windows of boards, each with factors and a unit of its own, and their layers."""

    seed: int
    config: LayersConfig
    noise: float = 0.0
    windows: list[Window] = field(default_factory=list)
    forward: list[Layers] = field(default_factory=list)
    factors: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Align each window with the one before."""
        scene = Boards(self.seed, size=(36, 72), speed_m=0.005, num=10)
        units = np.random.default_rng(self.seed).uniform(0.3, 3, NUM_WINDOWS)
        for k, unit in enumerate(units.tolist()):
            self.factors.append(scene.random_factors(100 * self.seed + k, 0.07))
            frames = np.arange(STEP * k, STEP * k + NUM)
            self.windows.append(scene.window(frames, self.factors[k], self.noise, unit))
            self.forward.append(self._align(k))

    def scale(self, k: int) -> float | None:
        return self.windows[k].unit_m / self.windows[k - 1].unit_m if k else None

    def _align(self, k: int) -> Layers:
        window, scale = self.windows[k], self.scale(k)
        if scale is None:
            return first_layers(window.labels())
        previous = self.windows[k - 1].prediction, self.forward[k - 1]
        return align_layers(previous, window.prediction, window.labels(), scale, self.config)[0]

    def smoothed(self, broken_before: int | None = None) -> list[Layers]:
        """Pass over the windows backwards; no scale is measured before one of them."""
        last_first = [
            (
                self.windows[k].prediction,
                self.forward[k],
                None if k == broken_before else self.scale(k),
            )
            for k in range(NUM_WINDOWS - 1, -1, -1)
        ]
        return list(smooth_layers(last_first, self.config))[::-1]

    def log_errors(self, layers: list[Layers]) -> list[Array]:
        """Return each window's (11,) mean log error of the wall and each board."""
        out = []
        for window, chosen in zip(self.windows, layers, strict=True):
            depth = apply_layers(window.prediction, chosen, self.config).depth
            ids = window.ids.ravel()
            sums = np.bincount(ids, window.log_error(depth).ravel(), minlength=11)
            out.append(sums / np.maximum(np.bincount(ids, minlength=11), 1))
        return out


def measured(**changes: Any) -> LayersConfig:
    chosen = {"shrink": False, "feather": 0.0, "tau_intra": 0.3, **changes}
    return LayersConfig(segmentation=SegmentationConfig(downscale=1), **chosen)


@pytest.mark.parametrize("seed", range(3))
def test_after_both_passes_every_window_has_the_mean_of_all(seed: int) -> None:
    chain = Chain(seed, measured())
    mean = np.mean(np.log(chain.factors), axis=0)
    smoothed = chain.smoothed()
    for layers, error in zip(smoothed, chain.log_errors(smoothed), strict=True):
        seen = error != 0
        assert seen.sum() > 6
        np.testing.assert_allclose(error[seen], mean[seen], atol=1e-3)
        np.testing.assert_allclose(layers.witnesses, NUM_WINDOWS)


def test_the_first_pass_alone_leaves_early_windows_behind() -> None:
    """Why there is a second one: the first window has heard nobody, the last one all."""
    chains = [Chain(seed, measured()) for seed in range(4)]
    first, last = (
        np.sqrt(np.mean([c.log_errors(c.forward)[k] ** 2 for c in chains])) for k in (0, -1)
    )
    both = np.sqrt(np.mean([c.log_errors(c.smoothed())[0] ** 2 for c in chains]))
    assert last < 0.7 * first
    assert both == pytest.approx(last, rel=0.02)


def test_by_default_the_second_pass_betters_early_windows_and_spoils_no_late_ones() -> None:
    config = LayersConfig(segmentation=SegmentationConfig(downscale=1))
    before, after = np.zeros(NUM_WINDOWS), np.zeros(NUM_WINDOWS)
    for seed in range(4):
        chain = Chain(seed, config, noise=0.005)
        before += [np.mean(error**2) for error in chain.log_errors(chain.forward)]
        after += [np.mean(error**2) for error in chain.log_errors(chain.smoothed())]
    assert after[:2].sum() < 0.5 * before[:2].sum()
    assert after[-2:].sum() < 1.1 * before[-2:].sum()
    assert after.sum() < 0.7 * before.sum()


def test_nothing_is_heard_across_a_scale_that_was_not_measured() -> None:
    chain = Chain(1, measured())
    chain.forward[3] = first_layers(chain.windows[3].labels())
    for k in (4, 5):
        chain.forward[k] = chain._align(k)
    smoothed = chain.smoothed(broken_before=3)
    errors = chain.log_errors(smoothed)
    for part in (slice(0, 3), slice(3, 6)):
        mean = np.mean(np.log(chain.factors[part]), axis=0)
        for error, layers in zip(errors[part], smoothed[part], strict=True):
            seen = error != 0
            np.testing.assert_allclose(error[seen], mean[seen], atol=1e-3)
            np.testing.assert_allclose(layers.witnesses, 3)


def test_a_single_window_is_left_as_it_is() -> None:
    chain = Chain(0, measured())
    window, layers = chain.windows[0], chain.forward[0]
    (only,) = smooth_layers([(window.prediction, layers, None)], chain.config)
    assert np.array_equal(only.labels, layers.labels)
    assert (only.scales == 1).all()
    assert (only.witnesses == 1).all()
    assert len(only.curve) == 0


# --- whole runs ---------------------------------------------------------------------------------

NUM_FRAMES = 24
SETTINGS = ["windows.size=8", "windows.overlap=3", "windows.min_parallax_px=0.2"]
ALWAYS = load_config(assignments=[*SETTINGS, "layers.enabled=always"])
NEVER = load_config(assignments=[*SETTINGS, "layers.enabled=never"])


@dataclass
class BendingBackbone(TrueBackbone):
    """Bends depth smoothly, differently in each window."""

    def predict(
        self,
        images: Sequence[Image],
        frames: NDArray[np.int64],
        intrinsics: NDArray[np.float64] | None,
    ) -> Prediction:
        prediction = super().predict(images, frames, intrinsics)
        if prediction.status is not WindowStatus.OK:
            return prediction
        phase = np.random.default_rng(int(frames[0])).uniform(0, 2 * np.pi)
        log_depth = np.log(prediction.depth / np.median(prediction.depth))
        prediction.depth[:] *= np.exp(0.12 * np.sin(1.5 * log_depth + phase))
        return prediction


@pytest.fixture(scope="module", autouse=True)
def no_pictures() -> Iterator[None]:
    """Leave out what takes seconds and is drawn in other tests."""
    with pytest.MonkeyPatch.context() as patch:
        leave_pictures_out(patch)
        yield


@pytest.fixture(scope="module")
def aligned(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return run(tmp_path_factory.mktemp("aligned"))


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return run(tmp_path_factory.mktemp("raw"), NEVER)


def run(folder: Path, config: Config = ALWAYS, backbone: TrueBackbone | None = None) -> Results:
    chosen = backbone or BendingBackbone()
    return Pipeline(Corridor(NUM_FRAMES), config, folder, backbone=chosen).run()


def stored_layers(folder: Path) -> list[Layers]:
    return [load_layers(path) for path in sorted((folder / "layers").glob("*.npz"))]


def test_a_run_with_layers_keeps_them_beside_the_depth_as_predicted(
    aligned: Results, raw: Results
) -> None:
    num = len(list((aligned.folder / "windows").glob("*.npz")))
    layers = stored_layers(aligned.folder)
    assert len(layers) == num >= 4
    assert any((chosen.scales != 1).any() or len(chosen.curve) for chosen in layers)
    for index in range(num):
        first, second = (
            WindowFiles(results.folder).load(index)[0].depth for results in (aligned, raw)
        )
        assert np.array_equal(first, second)  # layers are applied on use only


def test_layers_leave_the_path_alone_and_better_the_depth(aligned: Results, raw: Results) -> None:
    assert np.array_equal(aligned.trajectory.world_from_cam, raw.trajectory.world_from_cam)
    name = "by_median_ratio"
    error = raw.report["depth"][name]["abs_rel"]
    assert aligned.report["depth"][name]["abs_rel"] < 0.9 * error
    without = aligned.report["depth_without_layers"][name]["abs_rel"]
    assert without == pytest.approx(error, rel=1e-6)


def test_a_run_without_layers_has_none_in_its_files_and_report(raw: Results) -> None:
    assert stored_layers(raw.folder) == []
    assert raw.report["layers"] is None
    assert raw.report["depth_without_layers"] is None


def test_the_report_counts_what_became_of_the_layers(aligned: Results) -> None:
    counts = aligned.report["layers"]
    layers = stored_layers(aligned.folder)
    assert counts["layers"] == sum(len(chosen.scales) for chosen in layers)
    assert 0 < counts["linked"] <= counts["layers"]
    assert set(counts["windows"]) == {str(index) for index in range(len(layers))}
    second = counts["windows"]["1"]
    assert second["mismatch_after"] < 0.8 * second["mismatch_before"]


def same(first: list[Layers], second: list[Layers]) -> bool:
    pairs = list(zip(first, second, strict=True))
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for a, b in pairs for n in vars(a))


def test_a_broken_off_run_with_layers_ends_as_one_that_was_not(
    aligned: Results, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, backbone=BendingBackbone(interrupt_at=2))
    assert len(stored_layers(tmp_path)) == 2
    resumed = run(tmp_path)
    assert same(stored_layers(aligned.folder), stored_layers(tmp_path))
    assert np.array_equal(aligned.trajectory.world_from_cam, resumed.trajectory.world_from_cam)
    assert np.array_equal(aligned.cloud.points, resumed.cloud.points)


def test_a_run_whose_second_pass_was_broken_off_ends_the_same(
    aligned: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    num_windows = len(stored_layers(aligned.folder))

    class Interrupted(WindowFiles):
        num_saved = 0

        def save_layers(self, index: int, layers: Layers) -> None:
            Interrupted.num_saved += 1
            if Interrupted.num_saved > num_windows + 2:  # a little of the second pass
                raise KeyboardInterrupt
            super().save_layers(index, layers)

    with monkeypatch.context() as patch:
        patch.setattr(laser_slam.pipeline, "WindowFiles", Interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path)
    run(tmp_path)
    assert same(stored_layers(aligned.folder), stored_layers(tmp_path))


def test_a_run_with_a_blind_window_has_no_layers_there_and_goes_on(tmp_path: Path) -> None:
    results = run(tmp_path, backbone=BendingBackbone(statuses={1: WindowStatus.FAILED}))
    layers = stored_layers(tmp_path)
    assert len(layers[1].scales) == 0
    assert (layers[1].labels == 0).all()
    assert len(layers[2].scales) > 0
    counts = results.report["layers"]["windows"]
    assert counts["1"]["layers"] == counts["2"]["linked"] == 0
    assert np.isfinite(results.cloud.points).all()
    assert len(results.cloud.points) > 1000
