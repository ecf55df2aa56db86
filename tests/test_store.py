"""Files of the run folder appear whole or not at all, and give back what went in."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from laser_slam.config import load_config
from laser_slam.errors import RunFolderError
from laser_slam.store import (
    WindowFiles,
    atomic_write,
    link_latest,
    load_layers,
    load_prediction,
    new_run_folder,
    open_run_folder,
    save_layers,
    save_prediction,
)
from laser_slam.store.keyframes import load_originals, save_originals
from laser_slam.types import (
    NO_DISTORTION,
    Calibration,
    Image,
    Layers,
    Prediction,
    SequenceInfo,
    WindowStatus,
)

HEIGHT, WIDTH = 192, 640


def a_prediction(
    num: int = 3, height: int = HEIGHT, width: int = WIDTH, unit: float = 1.0, seed: int = 0
) -> Prediction:
    rng = np.random.default_rng(seed)
    depth = unit * rng.lognormal(0, 2, (num, height, width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    confidence = np.where(np.isfinite(depth), rng.random(depth.shape), 0).astype(np.float32)
    window_from_cam = np.tile(np.eye(4), (num, 1, 1))
    window_from_cam[:, :3, 3] = unit * rng.normal(size=(num, 3))
    intrinsics = np.tile(np.diag([500.1, 499.3, 1.0]), (num, 1, 1))
    return Prediction(np.arange(num) * 4, depth, confidence, window_from_cam, intrinsics)


def a_street(num: int = 3, height: int = HEIGHT, width: int = WIDTH) -> Image:
    y, x = np.mgrid[:height, :width]
    waves = [128 + 60 * np.sin(x / (9 + k)) + 60 * np.cos(y / (7 + k)) for k in range(3)]
    noise = np.random.default_rng(0).normal(0, 4, (num, height, width, 3))
    return np.clip(np.stack(waves, -1) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_prediction_survives_the_round_trip_in_any_unit(tmp_path: Path, unit: float) -> None:
    written = replace(
        a_prediction(unit=unit), status=WindowStatus.OK, warnings=("little motion", "größe")
    )
    save_prediction(tmp_path / "0.npz", written, a_street())
    read, colors = load_prediction(tmp_path / "0.npz")
    known = np.isfinite(written.depth)
    assert np.array_equal(np.isfinite(read.depth), known)
    assert np.abs(read.depth[known] / written.depth[known] - 1).max() <= 5e-4
    assert np.abs(read.confidence - written.confidence).max() <= 0.5 / 255 + 1e-6
    assert np.array_equal(read.window_from_cam, written.window_from_cam)
    assert np.array_equal(read.intrinsics, written.intrinsics)
    assert np.array_equal(read.frames, written.frames)
    assert (read.status, read.warnings) == (written.status, written.warnings)
    assert np.abs(colors.astype(float) - a_street()).mean() < 6


@pytest.mark.parametrize("ratio", [1e-9, 1e9])
def test_depths_out_of_range_become_unknown_and_never_wrong(tmp_path: Path, ratio: float) -> None:
    written = a_prediction()
    written.depth[0, 0, 0] = ratio
    written.confidence[0, 0, 0] = 1
    save_prediction(tmp_path / "0.npz", written, a_street())
    read, _ = load_prediction(tmp_path / "0.npz")
    assert np.isnan(read.depth[0, 0, 0])
    assert read.confidence[0, 0, 0] == 0


def test_a_window_without_depth_survives(tmp_path: Path) -> None:
    blank = replace(
        a_prediction(),
        depth=np.full((3, HEIGHT, WIDTH), np.nan, np.float32),
        confidence=np.zeros((3, HEIGHT, WIDTH), np.float32),
        status=WindowStatus.STATIC,
    )
    save_prediction(tmp_path / "0.npz", blank, a_street())
    read, _ = load_prediction(tmp_path / "0.npz")
    assert read.status is WindowStatus.STATIC
    assert np.isnan(read.depth).all()
    assert read.warnings == ()


def test_what_saving_returns_is_what_loading_gives(tmp_path: Path) -> None:
    returned, colors = save_prediction(tmp_path / "0.npz", a_prediction(), a_street())
    read, read_colors = load_prediction(tmp_path / "0.npz")
    assert np.array_equal(returned.depth, read.depth, equal_nan=True)
    assert np.array_equal(returned.confidence, read.confidence)
    assert np.array_equal(colors, read_colors)


def test_a_frame_takes_less_than_half_a_megabyte(tmp_path: Path) -> None:
    save_prediction(tmp_path / "0.npz", a_prediction(), a_street())
    assert (tmp_path / "0.npz").stat().st_size / 3 <= 500_000


@pytest.mark.parametrize("damage", ["cut", "bit", "text", "missing", "empty"])
def test_a_damaged_window_file_is_named_with_what_to_do(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "000007.npz"
    save_prediction(path, a_prediction(), a_street())
    data = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "bit":
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif damage == "missing":
        path.unlink()
    else:
        path.write_bytes(b"" if damage == "empty" else b"no window at all")
    with pytest.raises(RunFolderError, match=r"000007\.npz.*delete it and run again"):
        load_prediction(path)


def test_a_file_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "0.npz"
    save_prediction(path, a_prediction(), a_street())
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, allow_pickle=False, **{**arrays, "version": np.array(99)})
    with pytest.raises(RunFolderError, match="has format 99"):
        load_prediction(path)


def some_layers(seed: int = 0, num_knots: int = 9) -> Layers:
    """Three frames with 4, 0 and 300 layers: more than a byte counts."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((3, HEIGHT // 2, WIDTH // 2), np.uint16)
    labels[0] = rng.integers(0, 5, labels.shape[1:])
    labels[2].flat[: 300 * 40] = np.repeat(np.arange(1, 301), 40)
    starts = np.array([0, 4, 4, 304])
    depths = np.geomspace(0.3, 8, num_knots)
    return Layers(
        labels,
        starts,
        rng.lognormal(0, 0.1, 304),
        rng.integers(1, 9, 304).astype(float),
        np.stack([depths, rng.lognormal(0, 0.1, num_knots)], axis=1),
    )


@pytest.mark.parametrize("num_knots", [0, 9])
def test_layers_survive_the_round_trip_to_the_last_bit(tmp_path: Path, num_knots: int) -> None:
    written = some_layers(num_knots=num_knots)
    save_layers(tmp_path / "0.npz", written)
    read = load_layers(tmp_path / "0.npz")
    for name, values in vars(written).items():
        assert np.array_equal(getattr(read, name), values)
        assert getattr(read, name).dtype == values.dtype


def test_layers_take_little_beside_the_depth(tmp_path: Path) -> None:
    y, x = np.mgrid[: HEIGHT // 2, : WIDTH // 2]
    labels = np.tile(1 + x // 16 + 20 * (y // 16), (3, 1, 1)).astype(np.uint16)
    num = int(labels.max())
    starts = num * np.arange(4)
    scales = np.random.default_rng(0).lognormal(0, 0.1, 3 * num)
    save_layers(tmp_path / "0.npz", Layers(labels, starts, scales, scales, np.empty((0, 2))))
    assert (tmp_path / "0.npz").stat().st_size / 3 < 20_000


@pytest.mark.parametrize("place", [0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.999])
@pytest.mark.parametrize("damage", ["cut", "bits"])
def test_damaged_layers_are_named_with_what_to_do(
    tmp_path: Path, damage: str, place: float
) -> None:
    path = tmp_path / "000007.npz"
    save_layers(path, some_layers())
    data = bytearray(path.read_bytes())
    at = int(place * len(data))
    if damage == "cut":
        path.write_bytes(data[:at])
    else:
        data[at - 3 : at + 3] = bytes(255 - byte for byte in data[at - 3 : at + 3])
        path.write_bytes(data)
    with pytest.raises(RunFolderError, match=r"000007\.npz.*delete it and run again"):
        load_layers(path)


def test_no_single_byte_makes_layers_wrong_without_a_word(tmp_path: Path) -> None:
    path = tmp_path / "0.npz"
    ones = np.ones(2)
    written = Layers(np.ones((2, 8, 8), np.uint16), np.arange(3), ones, ones, np.empty((0, 2)))
    save_layers(path, written)
    whole, num_refused = path.read_bytes(), 0
    for at in range(0, len(whole), 7):
        path.write_bytes(whole[:at] + bytes([255 - whole[at]]) + whole[at + 1 :])
        try:
            read = load_layers(path)
        except RunFolderError:
            num_refused += 1
        else:  # a byte that says nothing, such as a date
            assert all(np.array_equal(getattr(read, n), v) for n, v in vars(written).items())
    assert num_refused > len(whole) / 7 / 2


def test_layers_of_another_version_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "0.npz"
    save_layers(path, some_layers())
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, allow_pickle=False, **{**arrays, "version": np.array(99)})
    with pytest.raises(RunFolderError, match="has format 99"):
        load_layers(path)


def test_a_windows_files_are_told_by_its_index(tmp_path: Path) -> None:
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    files = WindowFiles(tmp_path)
    for index in (0, 12):
        assert not files.has(index)
        files.save(index, a_prediction(seed=index), a_street())
        files.save_layers(index, some_layers(index))
        assert files.has(index)
    assert (tmp_path / "windows" / "000012.npz").exists()
    assert (tmp_path / "layers" / "000012.npz").exists()
    for index in (0, 12):
        assert np.array_equal(files.load_layers(index).scales, some_layers(index).scales)
        prediction, _ = files.load(index)
        assert np.array_equal(prediction.window_from_cam, a_prediction(seed=index).window_from_cam)
        depth_alone = files.load_depth(index)
        for name in ("depth", "confidence", "window_from_cam", "intrinsics", "frames"):
            alone, whole = getattr(depth_alone, name), getattr(prediction, name)
            assert np.array_equal(alone, whole, equal_nan=True)
    with pytest.raises(RunFolderError, match=r"000005\.npz.*delete it and run again"):
        files.load_layers(5)
    with pytest.raises(RunFolderError, match="holds other frames than window 12"):
        files.load(12, np.arange(3))


def test_a_written_file_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with atomic_write(path) as partial:
        assert partial.suffix == ".txt"
        partial.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write_half() -> None:
        with atomic_write(path) as partial:
            partial.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_one_line_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_space(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("laser_slam.store.files.os.fsync", no_space)
    with pytest.raises(RunFolderError, match=r"No space left on device; free some space"):
        save_prediction(tmp_path / "0.npz", a_prediction(), a_street())
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"No such file or directory; create its folder"):
        save_prediction(tmp_path / "nowhere" / "0.npz", a_prediction(1), a_street(1))


CONFIG = load_config()
SEQUENCE = {"name": "drive", "size": [192, 640], "intrinsics": None}


def test_a_new_folder_is_no_resumption_and_the_second_time_is(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "run"
    assert not open_run_folder(folder, CONFIG, SEQUENCE)
    assert (folder / "windows").is_dir()
    assert load_config(file=folder / "config.yaml") == CONFIG
    assert open_run_folder(folder, CONFIG, SEQUENCE)


def test_resuming_removes_what_a_killed_run_left_half_written(tmp_path: Path) -> None:
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    half = tmp_path / "windows" / ".000003.77.partial.npz"
    half.write_bytes(b"half")
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    assert not half.exists()


def test_a_run_with_other_settings_is_refused_by_the_names_that_differ(tmp_path: Path) -> None:
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    other = load_config(assignments=["windows.size=30", "registration.scale=l1"])
    with pytest.raises(RunFolderError) as error:
        open_run_folder(tmp_path, other, SEQUENCE)
    assert "windows.size (20, now 30)" in str(error.value)
    assert "registration.scale (log_huber, now l1)" in str(error.value)
    assert "overlap" not in str(error.value)


def test_a_run_of_another_input_is_refused(tmp_path: Path) -> None:
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    with pytest.raises(RunFolderError, match=r"other input: name \(drive, now walk\)"):
        open_run_folder(tmp_path, CONFIG, {**SEQUENCE, "name": "walk"})


def test_a_finished_run_is_never_written_over(tmp_path: Path) -> None:
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(RunFolderError, match="holds a finished run; choose another folder"):
        open_run_folder(tmp_path, CONFIG, SEQUENCE)


def test_a_folder_of_other_things_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(RunFolderError, match="neither empty nor a run folder"):
        open_run_folder(tmp_path, CONFIG, SEQUENCE)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("inside", [True, False])
def test_a_file_where_the_folder_should_be_is_named(tmp_path: Path, inside: bool) -> None:
    (tmp_path / "run").write_text("a file")
    folder = tmp_path / "run" / "inner" if inside else tmp_path / "run"
    with pytest.raises(RunFolderError, match="choose a"):
        open_run_folder(folder, CONFIG, SEQUENCE)


def test_a_broken_settings_file_in_the_run_folder_is_named(tmp_path: Path) -> None:
    open_run_folder(tmp_path, CONFIG, SEQUENCE)
    (tmp_path / "config.yaml").write_text("windows: [")
    with pytest.raises(RunFolderError, match=r"cannot read .*config\.yaml"):
        open_run_folder(tmp_path, CONFIG, SEQUENCE)


def test_two_runs_in_one_second_get_two_folders(tmp_path: Path) -> None:
    first = new_run_folder("drive", tmp_path)
    first.mkdir()
    second = new_run_folder("drive", tmp_path)
    assert first != second
    second.mkdir()
    for folder in (first, second):
        link_latest(folder)
        assert (tmp_path / "latest").resolve() == folder.resolve()
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["latest", first.name, second.name])


def test_images_whose_names_are_not_utf8_are_known_again(tmp_path: Path) -> None:
    names = (b"caf\xe9 1.jpg", "é\\2.jpg".encode())
    files = tuple(tmp_path / os.fsdecode(name) for name in names)
    info = SequenceInfo("drive", (30, 40), None, None, "unknown", files=files)
    calibration = Calibration(None, NO_DISTORTION, (30, 40), "none")
    save_originals(tmp_path, info, calibration)
    assert load_originals(tmp_path).files == files
