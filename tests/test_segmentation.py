"""Depth maps fall into the same regions as with scikit-image, whatever their unit or quality."""

import sys
import types
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.segmentation import felzenszwalb

from laser_slam.config import SegmentationConfig
from laser_slam.errors import ConfigError, DatasetError, DependencyError
from laser_slam.layers.felzenszwalb import Workspace, blur, partition
from laser_slam.layers.merging import merge_regions
from laser_slam.layers.sam2 import stack_masks
from laser_slam.layers.segmenters import SEGMENTERS, make_segmenter
from laser_slam.types import Prediction

Array = NDArray[np.float64]
NO_COLORS = np.zeros((0, 0, 0, 3), np.uint8)


def noisy_depth(seed: int, size: tuple[int, int] = (96, 160), noise: float = 0.01) -> Array:
    """Return a street: a road that rises to the horizon, a far wall, boxes; noise on each pixel."""
    rng = np.random.default_rng(seed)
    height, width = size
    rows = np.arange(height)[:, None] - 0.45 * height
    depth = np.minimum(1.6 * height / np.maximum(rows, 0.5), 60.0).repeat(width, axis=1)
    for _ in range(12):
        distance = rng.uniform(4, 40)
        top, left = rng.integers(0, height // 2), rng.integers(0, width)
        extent = (rng.uniform(0.3, 2.0, 2) * height * 2 / distance).astype(int) + 4
        box = depth[top : top + extent[0], left : left + extent[1]]
        box[:] = np.minimum(box, distance)
    return depth * np.exp(rng.normal(0, noise, size))


def window_of(depth: Array, confidence: Array | None = None) -> Prediction:
    """Make a prediction of (N, H, W) depth, confident wherever it is finite."""
    num = len(depth)
    trust = np.isfinite(depth).astype(np.float32) if confidence is None else confidence
    poses, intrinsics = np.tile(np.eye(4), (num, 1, 1)), np.tile(np.eye(3), (num, 1, 1))
    return Prediction(
        np.arange(num), depth.astype(np.float32), trust.astype(np.float32), poses, intrinsics
    )


def street(num: int = 3, **kwargs: float) -> Prediction:
    return window_of(np.stack([noisy_depth(seed, **kwargs) for seed in range(num)]))


def segment(window: Prediction, **settings: object) -> NDArray[np.uint16]:
    return make_segmenter(SegmentationConfig(**settings)).segment(window, NO_COLORS)


def rand_index(one: NDArray[np.integer], two: NDArray[np.integer]) -> float:
    """Return the adjusted Rand index of two partitions: 1 the same, 0 as by chance."""

    def pairs(counts: Array) -> float:
        return float((counts * (counts - 1) / 2).sum())

    table = np.zeros((one.max() + 1, two.max() + 1))
    np.add.at(table, (one.ravel(), two.ravel()), 1)
    both, rows, columns = pairs(table), pairs(table.sum(1)), pairs(table.sum(0))
    chance = rows * columns / pairs(np.array([one.size]))
    return (both - chance) / ((rows + columns) / 2 - chance)


def assert_gapless(labels: NDArray[np.uint16]) -> None:
    for frame in labels:
        assert set(np.unique(frame)) | {0} == set(range(int(frame.max()) + 1))


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("size", [(77, 259), (96, 160), (40, 41), (9, 120), (154, 518)])
@pytest.mark.parametrize("seed", range(3))
def test_the_partition_is_that_of_scikit_image(size: tuple[int, int], seed: int) -> None:
    for noise, scale, sigma, min_size in [
        (0.01, 300, 1.1, 60),
        (0.05, 30, 0.6, 20),
        (0.2, 9, 0, 5),
    ]:
        for image in (np.log(noisy_depth(seed, size, noise)), noisy_depth(seed, size, noise)):
            ours = partition(image, scale, sigma, min_size)
            theirs = felzenszwalb(
                image, scale=scale, sigma=sigma, min_size=min_size, channel_axis=None
            )
            assert ours.max() > 2
            assert rand_index(ours, theirs) > 0.9999
            assert (ours - 1 == theirs).mean() > 0.9999


def test_real_depth_in_whole_millimetres_falls_into_the_regions_of_scikit_image() -> None:
    depth = np.round(noisy_depth(1, (120, 160), 0.003) * 1000) / 1000  # many equal weights
    ours = partition(depth, 300, 1.1, 50)
    theirs = felzenszwalb(depth, scale=300, sigma=1.1, min_size=50, channel_axis=None)
    assert rand_index(ours, theirs) > 0.98


def test_a_workspace_serves_one_image_after_the_other() -> None:
    work = Workspace(96, 160)
    for seed in range(3):
        image = np.log(noisy_depth(seed))
        assert (partition(image, 100, 1.1, 30, work) == partition(image, 100, 1.1, 30)).all()


def test_huge_and_tiny_differences_in_one_image_do_not_upset_the_order() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(size=(30, 40)) * 10.0 ** rng.integers(-18, 6, (30, 40))
    ours = partition(image, 255.0, 0.0, 1)
    theirs = felzenszwalb(image, scale=255.0, sigma=0, min_size=1, channel_axis=None)
    assert rand_index(ours, theirs) > 0.9999


@pytest.mark.parametrize("seed", range(3))
def test_no_region_is_smaller_than_allowed(seed: int) -> None:
    image = np.log(noisy_depth(seed))
    image[np.random.default_rng(seed).uniform(size=image.shape) < 0.6] = np.nan
    labels = partition(image, 30, 1.1, 40)
    assert ((labels == 0) == np.isnan(image)).all()
    assert np.bincount(labels.ravel())[1:].min() >= 40


def test_unknown_pixels_part_what_lies_beside_them() -> None:
    image = np.ones((20, 41))
    image[:, 20] = np.nan
    labels = partition(image, 300, 1.1, 30)
    assert (labels[:, :20] == 1).all()
    assert (labels[:, 20] == 0).all()
    assert (labels[:, 21:] == 2).all()


def test_an_island_among_unknown_pixels_joins_the_most_similar_shore() -> None:
    image = np.where(np.arange(40) < 20, 1.0, 2.0)[None].repeat(20, axis=0)
    image[5:15, 15:25] = np.nan
    image[9:11, 19:21] = 1.9
    labels = partition(image, 10, 0.0, 30)
    assert labels[9, 19] == labels[9, 30] != labels[9, 5]


def test_the_blur_takes_nothing_from_unknown_pixels() -> None:
    image = np.full((12, 14), 3.0)
    image[4:7, 5:9] = np.nan
    known = np.isfinite(image)
    assert np.allclose(blur(image, 1.1)[known], 3.0, rtol=1e-14)
    assert np.isnan(blur(image, 1.1)[~known]).all()


@pytest.mark.parametrize("depth", ["log", "inverse"])
@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_the_unit_of_depth_changes_no_pixel(depth: str, downscale: int) -> None:
    scenes = [noisy_depth(seed, noise=noise) for seed in range(8) for noise in (0.01, 0.05)]
    window = window_of(np.stack(scenes))
    settings = {"depth": depth, "downscale": downscale, "merge": 0.01}
    labels = segment(window, **settings)
    for unit in (0.01, 100.0, 0.3048):
        other = window_of(window.depth * np.float32(unit))
        assert (segment(other, **settings) == labels).all()


def test_linear_depth_depends_on_its_unit_as_in_the_official_code() -> None:
    window = street()
    labels = segment(window, depth="linear")
    other = segment(window_of(window.depth * np.float32(0.01)), depth="linear")
    assert other.max() < labels.max()


def official_rules(depth: Array) -> NDArray[np.integer]:
    """Segment as the official code does, but for its merge, by scikit-image."""
    return felzenszwalb(depth, scale=300, sigma=1.1, min_size=500, channel_axis=None)


def test_the_official_settings_give_the_official_segments() -> None:
    window = window_of(noisy_depth(0, (154, 518))[None])
    labels = segment(
        window, depth="linear", downscale=1, scale=300, sigma=1.1, min_size_px=500, merge=0
    )
    theirs = official_rules(window.depth[0].astype(np.float64))
    assert rand_index(labels[0], theirs) > 0.9999


@pytest.mark.parametrize("downscale", [1, 2, 3, 8])
def test_a_cell_stands_for_a_block_and_is_known_where_any_pixel_is(downscale: int) -> None:
    rng = np.random.default_rng(downscale)
    depth = np.stack([noisy_depth(0, (37, 50)), noisy_depth(1, (37, 50))])
    depth[rng.uniform(size=depth.shape) < 0.7] = np.nan
    labels = segment(window_of(depth), downscale=downscale)
    assert labels.shape == (2, -(-37 // downscale), -(-50 // downscale))
    assert labels.dtype == np.uint16
    assert_gapless(labels)
    for i, j in np.ndindex(labels.shape[1:]):
        block = np.s_[:, i * downscale : (i + 1) * downscale, j * downscale : (j + 1) * downscale]
        assert (np.isfinite(depth[block]).any(axis=(1, 2)) == (labels[:, i, j] > 0)).all()


def test_half_the_resolution_finds_the_same_objects() -> None:
    depth = np.full((60, 80), 30.0)
    depth[10:40, 10:30], depth[20:50, 45:70] = 5.0, 9.0
    depth *= np.exp(np.random.default_rng(0).normal(0, 0.01, depth.shape))
    settings = {"scale": 300, "min_share": 0.02}
    full, half = (segment(window_of(depth[None]), downscale=f, **settings)[0] for f in (1, 2))
    for labels in (full, half.repeat(2, axis=0).repeat(2, axis=1)):
        insides = labels[13:37, 13:27], labels[23:47, 48:67], labels[:8]
        most = [int(np.bincount(inside.ravel()).argmax()) for inside in insides]
        assert len(set(most)) == 3
        for inside, label in zip(insides, most, strict=True):
            assert (inside == label).mean() > 0.9


def test_frames_in_parallel_are_as_one_by_one() -> None:
    window = street(8)
    segmenter = make_segmenter(SegmentationConfig(depth="linear", merge=0))
    together = segmenter.segment(window, NO_COLORS)
    for labels, depth in zip(together, window.depth, strict=True):
        assert (segmenter.segment(window_of(depth[None]), NO_COLORS)[0] == labels).all()


def staircase(heights: list[float]) -> tuple[NDArray[np.int32], Array]:
    """Return regions side by side, 4 pixels wide, and their values."""
    labels = np.arange(1, len(heights) + 1, dtype=np.int32).repeat(4)[None].repeat(6, axis=0)
    return labels, np.asarray(heights)[labels - 1]


def test_equal_neighbours_become_one_layer_and_others_stay() -> None:
    labels, values = staircase([1.0, 1.01, 5.0, 5.02, 1.0])
    merged = merge_regions(labels, values, 0.1, "robust")
    assert merged[0, ::4].tolist() == [1, 1, 2, 2, 3]


def test_a_slope_is_not_swallowed_step_by_step() -> None:
    labels, values = staircase([0.09 * step for step in range(40)])
    assert merge_regions(labels, values, 0.1, "range").max() == 1
    merged = merge_regions(labels, values, 0.1, "robust")
    spans = [np.ptp(values[merged == label]) for label in range(1, merged.max() + 1)]
    assert max(spans) < 0.3
    assert merged.max() < 40


def test_the_first_region_merges_like_any_other_and_unknown_never() -> None:
    labels, values = staircase([1.0, 1.0, 1.0])
    assert merge_regions(labels, values, 0.1, "range").max() == 1
    labels[labels == 2] = 0
    labels[labels == 3] = 2
    merged = merge_regions(labels, values, 0.1, "robust")
    assert merged[0, ::4].tolist() == [1, 0, 2]


def test_a_large_region_does_not_move_for_a_small_one() -> None:
    labels, values = staircase([0.0, 0.08, 0.16])
    labels = np.concatenate([np.ones((6, 400), np.int32), labels], axis=1)
    values = np.concatenate([np.zeros((6, 400)), values], axis=1)
    assert merge_regions(labels, values, 0.1, "robust")[0, -12::4].tolist() == [1, 1, 2]


def test_many_regions_merge_as_the_slow_way_says() -> None:
    """Single linkage is the connected components of the pairs below the threshold."""
    rng = np.random.default_rng(0)
    labels = np.arange(1, 3601, dtype=np.int32).reshape(60, 60)
    values = rng.uniform(size=(60, 60))
    merged = merge_regions(labels, values, 0.15, "range")
    pairs = [(labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1])]
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()]) for a, b in pairs], axis=1) - 1
    close = abs(values.ravel()[ends[0]] - values.ravel()[ends[1]]) < 0.15
    graph = coo_array((np.ones(close.sum()), ends[:, close]), shape=(3600, 3600))
    num, expected = connected_components(graph, directed=False)
    assert merged.max() == num > 100
    assert rand_index(merged, expected.reshape(60, 60)) == 1


def test_one_far_pixel_moves_the_official_threshold_but_not_ours() -> None:
    window = street(1)
    depth = window.depth.copy()
    depth[0, 0, 0] = 2000.0
    outlier = window_of(depth)
    layers = {
        (rule, name): int(segment(case, depth="linear", merge=0.05, merge_rule=rule).max())
        for rule in ("robust", "range")
        for name, case in (("clean", window), ("outlier", outlier))
    }
    assert abs(layers["robust", "outlier"] - layers["robust", "clean"]) <= 1
    assert layers["range", "outlier"] < layers["range", "clean"] / 2


def test_the_official_range_is_that_of_confident_depth() -> None:
    window = street(1)
    confidence = np.where(window.depth > 20, 0.2, 0.9)
    trusted = window_of(window.depth, confidence)
    settings = {"depth": "linear", "merge": 0.1, "merge_rule": "range"}
    assert segment(trusted, **settings).max() > segment(window, **settings).max()


@pytest.mark.parametrize("depth", ["log", "inverse", "linear"])
@pytest.mark.parametrize("rule", ["robust", "range"])
@pytest.mark.parametrize("size", [(20, 30), (1, 1), (1, 9), (7, 1)])
def test_bad_depth_has_a_defined_result(depth: str, rule: str, size: tuple[int, int]) -> None:
    unknown, constant = np.full((2, *size), np.nan), np.full((2, *size), 3.7)
    single = unknown.copy()
    single[0, -1, -1] = 2.0
    infinite = np.full((2, *size), np.inf)
    nothing = np.zeros((2, *size))
    settings = {"depth": depth, "merge_rule": rule, "merge": 0.02, "downscale": 1}
    assert (segment(window_of(unknown), **settings) == 0).all()
    assert (segment(window_of(constant), **settings) == 1).all()
    assert (segment(window_of(single), **settings) == np.isfinite(single)).all()
    assert (segment(window_of(constant, nothing), **settings) == 0).all()
    for depths in (infinite, nothing, -constant):
        assert (segment(window_of(depths, nothing), **settings) == 0).all()


def test_a_window_without_frames_has_no_layers() -> None:
    assert segment(window_of(np.zeros((0, 10, 12)))).shape == (0, 5, 6)


def test_a_frame_without_depth_leaves_the_others_alone() -> None:
    depth = street(2).depth.astype(np.float64)
    labels = segment(window_of(depth))
    depth = np.concatenate([depth, np.full_like(depth[:1], np.nan)])
    assert (segment(window_of(depth))[:2] == labels).all()
    assert (segment(window_of(depth))[2] == 0).all()


def test_an_unknown_segmenter_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"no 'felzenswalb'; there is felzenszwalb, label_files"):
        make_segmenter(SegmentationConfig(segmenter="felzenswalb"))
    assert set(SEGMENTERS) == {"felzenszwalb", "label_files", "sam2"}


def files_segmenter(folder: Path, **settings: object) -> NDArray[np.uint16]:
    depth = np.ones((1, 9, 14))
    depth[0, 0, 0] = np.nan
    config = {"segmenter": "label_files", "label_folder": str(folder), **settings}
    return segment(window_of(depth), **config)


@pytest.mark.parametrize("kind", ["uint8.png", "uint16.png", "int64.npy"])
def test_label_files_are_read_and_numbered_without_gaps(tmp_path: Path, kind: str) -> None:
    dtype, suffix = kind.split(".")
    labels = np.array([[0, 9], [200, 9]], dtype).repeat(18, axis=0).repeat(28, axis=1)
    path = tmp_path / f"000000.{suffix}"
    if suffix == "npy":
        np.save(path, labels)
    else:
        assert cv2.imwrite(str(path), labels)
    read = files_segmenter(tmp_path, downscale=1)
    expected = np.ones((9, 14), int)
    expected[:, 7:], expected[4:, :7] = 2, 3
    expected[0, 0] = 0  # unknown depth
    assert (read[0] == expected).all()
    halved = files_segmenter(tmp_path, downscale=2)
    assert halved.shape == (1, 5, 7)
    assert_gapless(halved)
    assert halved[0, 0].tolist() == [1, 1, 1, 2, 2, 2, 2]  # the corner has known pixels


def test_faults_of_label_files_are_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"label_folder: 'label_files' needs the folder"):
        segment(street(1), segmenter="label_files")
    with pytest.raises(ConfigError, match=r"label_folder: no folder .*nowhere"):
        files_segmenter(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"no label map of frame 0: looked for 000000.png"):
        files_segmenter(tmp_path)
    path = tmp_path / "000000.png"
    path.write_bytes(b"no image")
    with pytest.raises(DatasetError, match=r"000000.png: .* this is nothing readable"):
        files_segmenter(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(DatasetError, match=r"nothing readable"):
        files_segmenter(tmp_path)
    cv2.imwrite(str(path), np.zeros((4, 5, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"in one channel, this is uint8 \(4, 5, 3\)"):
        files_segmenter(tmp_path)
    path.unlink()
    for wrong, message in (
        (np.zeros((4, 5)), r"whole numbers in one channel, this is float64 \(4, 5\)"),
        (np.array([["a"]], dtype=object), r"nothing readable"),
        (np.full((4, 5), -2), r"must not be negative, the least is -2"),
        (np.zeros((0, 5), int), r"this is int64 \(0, 5\)"),
    ):
        np.save(tmp_path / "000000.npy", wrong, allow_pickle=True)
        with pytest.raises(DatasetError, match=message):
            files_segmenter(tmp_path)


def test_more_layers_than_sixteen_bits_can_count_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "000000.npy", np.arange(270 * 260).reshape(270, 260))
    window = window_of(np.ones((1, 270, 260)))
    config = {"segmenter": "label_files", "label_folder": str(tmp_path), "downscale": 1}
    with pytest.raises(ConfigError, match=r"70200 layers, at most 65535 can be: raise"):
        segment(window, **config)
    noise = window_of(np.exp(np.random.default_rng(0).normal(0, 5, (1, 500, 500))))
    with pytest.raises(ConfigError, match=r"at most 65535"):
        segment(noise, downscale=1, scale=1e-6, sigma=0, min_size_px=1)


def test_smaller_masks_lie_on_larger_ones() -> None:
    large, small = np.zeros((4, 6), bool), np.zeros((4, 6), bool)
    large[:, :4], small[1:3, 1:3] = True, True
    for masks in ([large, small], [small, large]):
        labels = stack_masks(masks, (4, 6))
        assert labels[0].tolist() == [2, 2, 2, 2, 1, 1]
        assert labels[1].tolist() == [2, 3, 3, 2, 1, 1]
    assert (stack_masks([], (4, 6)) == 1).all()


class FakeGenerator:
    """Stand for SAM 2: a mask wherever one colour is, the largest not first."""

    def __init__(self, model: dict[str, object]) -> None:
        assert model["device"] == "cpu"

    def generate(self, image: NDArray[np.uint8]) -> list[dict[str, object]]:
        assert image.dtype == np.uint8
        assert image.shape[2] == 3
        return [{"segmentation": image[..., 0] == value, "area": 0} for value in (50, 90)]


def fake_modules(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Install a stand-in for SAM 2 and torch; return the list that its calls go to."""
    calls: list[tuple[object, ...]] = []

    def build_sam2(
        config_file: str, ckpt_path: str, device: str, *, apply_postprocessing: bool
    ) -> dict[str, object]:
        calls.append((config_file, ckpt_path, apply_postprocessing))
        if config_file == "wrong.yaml":
            raise RuntimeError("missing keys")
        return {"device": device}

    contents: dict[str, dict[str, object]] = {
        "sam2": {},
        "sam2.build_sam": {"build_sam2": build_sam2},
        "sam2.automatic_mask_generator": {"SAM2AutomaticMaskGenerator": FakeGenerator},
        "torch": {"cuda": types.SimpleNamespace(is_available=lambda: False)},
    }
    for name, members in contents.items():
        module = types.ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return calls


def test_masks_of_sam2_become_layers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = fake_modules(monkeypatch)
    weights = tmp_path / "weights.pt"
    weights.touch()
    config = SegmentationConfig(
        segmenter="sam2", sam2_checkpoint=str(weights), sam2_config="tiny.yaml", downscale=2
    )
    colors = np.zeros((2, 10, 20, 3), np.uint8)
    colors[0, :, :12, 0], colors[0, 4:8, 4:8, 0] = 90, 50
    depth = np.ones((2, 10, 20))
    depth[0, :, 18:] = np.nan
    labels = make_segmenter(config).segment(window_of(depth), colors)
    assert calls == [("tiny.yaml", str(weights), False)]
    assert labels[0, 0].tolist() == [2, 2, 2, 2, 2, 2, 1, 1, 1, 0]
    assert labels[0, 2].tolist() == [2, 2, 3, 3, 2, 2, 1, 1, 1, 0]
    assert (labels[1] == 1).all()  # no mask: one layer


def test_faults_of_sam2_are_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    weights = tmp_path / "weights.pt"
    with pytest.raises(ConfigError, match=r"sam2_checkpoint: no file '.*weights.pt'; get the"):
        make_segmenter(SegmentationConfig(segmenter="sam2", sam2_checkpoint=str(weights)))
    with pytest.raises(ConfigError, match=r"sam2_checkpoint: not set; get the"):
        make_segmenter(SegmentationConfig(segmenter="sam2"))
    weights.touch()
    config = {"segmenter": "sam2", "sam2_checkpoint": str(weights)}
    monkeypatch.setitem(sys.modules, "sam2", None)
    with pytest.raises(DependencyError, match=r"needs SAM 2 .* pip install git\+https"):
        make_segmenter(SegmentationConfig(**config))
    fake_modules(monkeypatch)
    with pytest.raises(ConfigError, match=r"does not load .* 'wrong.yaml': missing keys"):
        make_segmenter(SegmentationConfig(sam2_config="wrong.yaml", **config))
