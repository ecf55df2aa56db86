"""The command line: one line for each bad input, the right exit code, nothing half-written."""

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from corridor import SIZE, TrueBackbone, true_intrinsics, true_pose, view
from PIL import Image
from quick_runs import leave_pictures_out
from typer.testing import CliRunner, Result

from laser_slam import __version__
from laser_slam.backbones import BACKBONES
from laser_slam.cli import app
from laser_slam.config import load_config, shipped_configs

NUM_FRAMES = 16
SMALL = ["--set", "windows.size=8", "--set", "windows.overlap=3"]
FOV = ["--fov", "80"]


class InterruptedBackbone(TrueBackbone):
    """Ctrl-C comes while the third window is predicted."""

    def predict(self, *arguments):  # type: ignore[no-untyped-def]
        if self.calls == 2:
            signal.raise_signal(signal.SIGINT)
        return super().predict(*arguments)


def true_backbone(config: object) -> TrueBackbone:
    return TrueBackbone()


def interrupted_backbone(config: object) -> TrueBackbone:
    return InterruptedBackbone()


def broken_backbone(config: object) -> TrueBackbone:
    raise ZeroDivisionError("a bug")


@pytest.fixture(autouse=True)
def known_backbones(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("true", "interrupted", "broken"):
        monkeypatch.setitem(BACKBONES, name, f"{__name__}:{name}_backbone")
    monkeypatch.delenv("LASER_SLAM_KITTI", raising=False)


@pytest.fixture
def cheap_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_pictures_out(monkeypatch)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("material") / "walk"
    folder.mkdir()
    for frame in range(NUM_FRAMES):
        Image.fromarray(view(frame)[0]).save(folder / f"view{frame}.png")
    return folder


@pytest.fixture(scope="module")
def kitti_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    sequence = root / "sequences" / "03"
    (sequence / "image_0").mkdir(parents=True)
    (root / "poses").mkdir()
    for frame in range(NUM_FRAMES):
        grey = view(frame)[0].mean(axis=-1).astype(np.uint8)
        Image.fromarray(grey).save(sequence / "image_0" / f"{frame:06d}.png")
    projection = np.hstack([true_intrinsics(), np.zeros((3, 1))]).ravel()
    (sequence / "calib.txt").write_text("P0: " + " ".join(map(str, projection)) + "\n")
    np.savetxt(sequence / "times.txt", np.arange(NUM_FRAMES) / 10)
    poses = np.stack([true_pose(frame)[:3].ravel() for frame in range(NUM_FRAMES)])
    np.savetxt(root / "poses" / "03.txt", poses)
    return root


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def the_line(result: Result, code: int = 1) -> str:
    """Return the one line that an error must be."""
    assert result.exit_code == code, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("laser-slam: ")]
    assert len(lines) == 1, result.output
    assert "Traceback" not in result.output
    return lines[0]


def test_kitti_maps_and_scores_a_sequence(
    kitti_root: Path, tmp_path: Path, cheap_pictures: None
) -> None:
    result = run("kitti", "03", "--root", kitti_root, "--backbone", "true", *SMALL, "--out",
                 tmp_path / "run", "--quiet")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "16, 16 keyframes" in result.stdout
    assert "ATE (Sim(3))" in result.stdout
    assert (tmp_path / "run" / "map.ply").stat().st_size > 10_000
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["trajectory"]["ate_sim3_m"]["rmse"] < 2e-3


def test_images_are_mapped_in_natural_order_and_the_report_names_the_calibration(
    photos: Path, tmp_path: Path, cheap_pictures: None
) -> None:
    result = run("images", photos, *FOV, "--backbone", "true", *SMALL, "--out", tmp_path / "run")
    assert result.exit_code == 0, result.output
    assert f"mapping: {NUM_FRAMES} of {NUM_FRAMES}" in result.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert "80" in report["sequence"]["intrinsics_source"]
    assert report["trajectory"] is None


def test_a_truncated_png_in_the_middle_is_warned_of_and_the_run_goes_on(
    photos: Path, tmp_path: Path, cheap_pictures: None
) -> None:
    folder = tmp_path / "walk"
    folder.mkdir()
    for path in photos.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    whole = (folder / "view7.png").read_bytes()
    (folder / "view7.png").write_bytes(whole[: len(whole) // 3])
    result = run("images", folder, *FOV, "--backbone", "true", *SMALL, "--out", tmp_path / "run",
                 "--quiet")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "frame 7 cannot be read" in result.stderr
    assert "1 unreadable" in result.stdout
    lines = (tmp_path / "run" / "trajectory_kitti.txt").read_text().splitlines()
    assert len(lines) == NUM_FRAMES


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Let SIGINT interrupt: shells make programs that they start in the background deaf to it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c", "cheap_pictures")
def test_ctrl_c_says_what_is_kept_and_how_to_go_on(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    command = ["images", photos, *FOV, "--out", folder, "--quiet", "--backbone", "interrupted"]
    command += ["--set", "windows.size=4", "--set", "windows.overlap=1"]
    line = the_line(run(*command), code=130)
    kept = len(list((folder / "windows").iterdir()))
    assert 2 <= kept < 5  # reading and predicting are ahead
    assert f"{kept} windows are kept" in line
    assert f"--out {folder} goes on" in line
    assert not list(folder.rglob("*partial*"))
    assert not (folder / "map.ply").exists()
    monkeypatch.setitem(BACKBONES, "interrupted", BACKBONES["true"])
    assert run(*command).exit_code == 0
    assert (folder / "map.ply").exists()


def test_a_full_disk_is_one_line_and_leaves_no_half_file(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []

    def fill_up(descriptor: int) -> None:
        synced.append(descriptor)
        if len(synced) > 5:  # sequence, settings, manifest, calibration, one window
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("laser_slam.store.files.os.fsync", fill_up)
    result = run("images", photos, *FOV, "--backbone", "true", *SMALL, "--out", tmp_path / "run",
                 "--quiet")  # fmt: skip
    assert "No space left on device; free some space" in the_line(result)
    assert not list((tmp_path / "run").rglob("*partial*"))
    assert len(list((tmp_path / "run" / "windows").iterdir())) == 1


def a_text_named_mp4(folder: Path) -> list[object]:
    (folder / "drive.mp4").write_text("no video")
    return ["video", folder / "drive.mp4"]


def an_empty_folder(folder: Path) -> list[object]:
    (folder / "empty").mkdir()
    return ["images", folder / "empty"]


def one_image(folder: Path) -> list[object]:
    (folder / "one").mkdir()
    Image.fromarray(view(0)[0]).save(folder / "one" / "a.png")
    return ["images", folder / "one"]


def images_of_two_sizes(folder: Path) -> list[object]:
    for index in range(4):
        size = (SIZE[1], SIZE[0]) if index else (64, 64)
        Image.new("RGB", size).save(folder / f"{index}.png")
    return ["images", folder]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (lambda folder: ["images", folder / "nowhere"], "nowhere"),
        (an_empty_folder, "no images"),
        (one_image, "1 image"),
        (images_of_two_sizes, "64x64"),
        (lambda folder: ["video", folder / "nowhere.mp4"], "nowhere.mp4"),
        (a_text_named_mp4, "drive.mp4"),
        (lambda folder: ["kitti", "03"], "LASER_SLAM_KITTI"),
        (lambda folder: ["kitti", "03", "--root", folder], "no folder 'sequences'"),
        (lambda folder: ["eval", folder], "no finished run"),
    ],
)
def test_a_bad_input_is_one_line(
    arguments: Callable[[Path], list[object]],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command = arguments(tmp_path)
    before = set(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    assert words in the_line(run(*command))
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--set", "windows.sise=40"], "did you mean windows.size?"),
        (["--set", "windows.size=two"], "windows.size"),
        (["--set", "windows.size"], "section.key=value"),
        (["--set", "windows.overlap=20"], "must be smaller than size"),
        (["--config", "nowhere.yaml"], "cannot read settings file nowhere.yaml"),
        (["--backbone", "magic"], "no 'magic'; there is classical"),
        (["--intrinsics", "1,2,3"], "fx,fy,cx,cy"),
        (["--intrinsics", "500,500,a,b"], "fx,fy,cx,cy"),
        (["--intrinsics", "-5,500,64,36"], "-5"),
        (["--fov", "200"], "200"),
    ],
)
def test_a_bad_option_is_one_line_and_makes_no_folder(
    option: list[str], words: str, photos: Path, tmp_path: Path
) -> None:
    result = run("images", photos, "--out", tmp_path / "run", *option)
    assert words in the_line(result)
    assert not (tmp_path / "run").exists()


def test_an_out_folder_that_is_a_file_or_of_other_things_is_refused(
    photos: Path, tmp_path: Path
) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    common = ["images", photos, *FOV, "--backbone", "true"]
    assert "is a file" in the_line(run(*common, "--out", tmp_path / "notes.txt"))
    assert "neither empty nor a run folder" in the_line(run(*common, "--out", tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_an_out_folder_that_cannot_be_written_is_refused(photos: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    result = run("images", photos, *FOV, "--backbone", "true", "--out", tmp_path / "run")
    assert "Permission denied" in the_line(result)


def test_poses_of_another_length_are_named(kitti_root: Path, tmp_path: Path) -> None:
    poses = kitti_root / "poses" / "03.txt"
    whole = poses.read_text()
    try:
        poses.write_text("".join(whole.splitlines(keepends=True)[:-4]))
        line = the_line(run("kitti", "03", "--root", kitti_root, "--out", tmp_path / "run"))
    finally:
        poses.write_text(whole)
    assert "03.txt" in line
    assert "12" in line


def test_a_bug_keeps_its_traceback(photos: Path) -> None:
    result = run("images", photos, "--backbone", "broken")
    assert isinstance(result.exception, ZeroDivisionError)


@pytest.mark.parametrize(
    "arguments", [["nonsense"], ["images"], ["kitti", "03", "--nonsense"], ["images", ".", "--fov"]]
)
def test_wrong_usage_exits_with_2(arguments: list[str]) -> None:
    assert run(*arguments).exit_code == 2


def test_config_says_what_each_setting_means_and_may_be() -> None:
    lines = run("config").stdout.splitlines()
    [stride] = [line for line in lines if line.startswith("  stride: 1  # every so many-th row")]
    assert stride.endswith("[>= 1]")
    assert any("[anchors | points | joint]" in line for line in lines)
    bare = [line for line in lines if "  # " not in line]
    assert not bare, f"settings without a description: {bare}"


def test_config_prints_settings_that_load_again(tmp_path: Path) -> None:
    result = run("config", "--set", "windows.size=31")
    (tmp_path / "all.yaml").write_text(result.stdout)
    assert load_config(file=tmp_path / "all.yaml").windows.size == 31


@pytest.mark.parametrize("path", sorted(shipped_configs().glob("*.yaml")), ids=lambda p: p.stem)
def test_every_shipped_settings_file_loads_by_name_and_changes_something(path: Path) -> None:
    result = run("config", "--config", path.stem)
    assert result.exit_code == 0, result.output
    assert result.stdout != run("config").stdout
    comments = [line for line in path.read_text().splitlines() if "#" in line]
    assert comments, f"{path.name} must say why it differs"


def test_the_version_is_told() -> None:
    assert run("--version").stdout.strip() == f"laser-slam {__version__}"


def test_help_is_quick_and_loads_nothing_heavy() -> None:
    """In a process of its own, for what this one has loaded already."""
    script = (
        "import sys, time; start = time.process_time(); sys.argv = ['laser-slam', '--help']\n"
        "from laser_slam.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code\n"
        "heavy = {'open3d', 'torch', 'numba', 'cv2', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert time.process_time() - start < 0.5\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Commands" in done.stdout


@pytest.mark.parametrize("wrong", ["--only=3", "--set=windows.sise=9", "--backbone=nope"])
def test_a_list_of_what_cannot_be_run_is_the_error_alone(wrong: str) -> None:
    result = run("bench", "kitti", "--list", wrong)
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
