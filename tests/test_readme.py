"""What the README shows works as it stands there."""

import re
from pathlib import Path

import pytest
from corridor import TrueBackbone, view
from PIL import Image
from quick_runs import leave_pictures_out
from typer.testing import CliRunner

from laser_slam.backbones import BACKBONES
from laser_slam.cli import app

README = (Path(__file__).parents[1] / "README.md").read_text()
MAKEFILE = (Path(__file__).parents[1] / "Makefile").read_text()


def true_backbone(config: object) -> TrueBackbone:
    return TrueBackbone()


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Word by word, on images that lie where it expects them."""
    leave_pictures_out(monkeypatch)
    monkeypatch.setitem(BACKBONES, "classical", f"{__name__}:true_backbone")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive").mkdir()
    for frame in range(14):
        Image.fromarray(view(frame)[0]).save(tmp_path / "drive" / f"{frame}.png")
    example = re.search(r"```python\n(.*?)```", README, re.DOTALL)
    assert example is not None
    exec(compile(example.group(1), "README.md", "exec"), {})  # the README is ours
    assert capsys.readouterr().out.startswith("(14, 4, 4)")


def test_every_command_of_the_readme_exists() -> None:
    commands = set(re.findall(r"laser-slam ((?:predict )?[a-z]+) ?", " ".join(code_blocks())))
    assert {"images", "video", "kitti", "eval", "predict kitti", "export"} <= commands
    for command in commands:
        assert CliRunner().invoke(app, [*command.split(), "--help"]).exit_code == 0, command


def test_every_option_of_the_readme_exists() -> None:
    helps = [
        CliRunner().invoke(app, [*command.split(), "--help"], env={"COLUMNS": "200"}).output
        for command in ("images", "kitti", "eval", "export", "view", "replay", "predict kitti")
    ]
    for option in set(re.findall(r"--[a-z-]+", " ".join(code_blocks()))):
        assert any(option in text for text in helps), option


def test_every_make_target_of_the_readme_exists() -> None:
    targets = set(re.findall(r"`?make ([a-z]+)`", README)) | {"demo"}
    for target in targets:
        assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), target


def code_blocks() -> list[str]:
    blocks = re.findall(r"```\n(.*?)```", README, re.DOTALL)
    lines = [line.split("#")[0] for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("laser-slam")]
