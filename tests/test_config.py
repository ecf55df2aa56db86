"""Settings: one default each, layered, strict, and refused in words that say what to do."""

from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from laser_slam.config import Config, dump_config, load_config, setting_names, shipped_configs
from laser_slam.errors import ConfigError

SHIPPED = sorted(path.stem for path in shipped_configs().glob("*.yaml"))


def refusal(*assignments: str) -> str:
    with pytest.raises(ConfigError) as error:
        load_config(assignments=assignments)
    text = str(error.value)
    assert "\n" not in text
    return text


def test_without_settings_the_defaults_hold() -> None:
    assert load_config() == Config()


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_file_loads(name: str) -> None:
    assert isinstance(load_config(name), Config)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_files_hold_only_what_differs(name: str) -> None:
    def differs(given: dict[str, object], defaults: object) -> None:
        for key, value in given.items():
            default = getattr(defaults, key)
            if isinstance(value, dict):
                differs(value, default)
            else:
                assert value != default, f"{name}: {key} repeats the default"

    differs(yaml.safe_load((shipped_configs() / f"{name}.yaml").read_text()) or {}, Config())


def test_later_layers_win(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("windows:\n  size: 30\n  overlap: 7\nregistration:\n  min_pixels: 50\n")
    config = load_config(file=file, assignments=["windows.size=40", "windows.size=50"])
    assert (config.windows.size, config.windows.overlap) == (50, 7)
    assert config.registration.min_pixels == 50


def test_a_file_wins_over_a_shipped_name(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("windows:\n  size: 77\n")
    for name in SHIPPED:
        assert load_config(name, file).windows.size == 77


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "empty.yaml"
    file.write_text("# nothing yet\n")
    assert load_config(file=file) == Config()


def test_dumped_settings_load_to_the_same(tmp_path: Path) -> None:
    config = load_config(assignments=["windows.size=33", "registration.scale=l1"])
    file = tmp_path / "config.yaml"
    file.write_text(dump_config(config))
    assert load_config(file=file) == config


def test_small_numbers_in_any_notation_are_numbers() -> None:
    """YAML reads 1e-9 as a string; a setting does not."""
    for text in ("1e-9", "1.0e-9", "0.000000001"):
        config = load_config(assignments=[f"fusion.min_confidence={text}"])
        assert config.fusion.min_confidence == pytest.approx(1e-9)


def test_settings_are_frozen() -> None:
    with pytest.raises(ValidationError):
        Config().windows.size = 3  # type: ignore[misc]


def test_every_setting_is_described() -> None:
    def check(model: type[BaseModel]) -> None:
        for key, field in model.model_fields.items():
            if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
                check(field.annotation)
            else:
                assert field.description, f"{model.__name__}.{key} has no description"

    check(Config)
    names = list(setting_names())
    assert "windows.size" in names
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("assignment", "text"),
    [
        ("windows.sise=30", "windows.sise: no such setting (did you mean windows.size?)"),
        ("windos.size=30", "windos.size: no such setting (did you mean windows.size?)"),
        ("size=30", "size: no such setting (did you mean windows.size?)"),
        ("windows.size=2", "windows: size (2) must be 3 or more, or auto"),
        (
            "windows.overlap=25",
            "windows: overlap (25) must be smaller than size (20): "
            "lower windows.overlap or raise windows.size",
        ),
        ("windows=3", "windows: a section needs settings below it, got 3"),
        ("windows=", "windows: a section needs settings below it, got None"),
        ("windows.size", "--set wants section.key=value, got 'windows.size'"),
        ("=3", "--set wants section.key=value, got '=3'"),
        ("windows..size=3", "--set wants section.key=value, got 'windows..size=3'"),
        ("windows.size=[1", "windows.size: '[1' is no YAML value"),
        (
            "registration.scale=mean",
            "registration.scale: input should be 'log_huber', 'huber', 'l1' or 'closed_form', "
            "got 'mean'",
        ),
        ("fusion.min_confidence=.nan", "fusion.min_confidence: input should be a finite number"),
        (
            "windows.min_parallax_px=.inf",
            "windows.min_parallax_px: input should be a finite number",
        ),
    ],
)
def test_a_wrong_assignment_is_refused_in_one_line(assignment: str, text: str) -> None:
    assert refusal(assignment).startswith(text)


def test_all_faults_are_named_at_once() -> None:
    text = refusal("windows.sise=30", "registration.min_pixels=1")
    assert "windows.sise" in text
    assert "registration.min_pixels" in text


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError) as error:
        load_config("kiti")
    assert str(error.value) == f"no settings named 'kiti'; there are: {', '.join(SHIPPED)}"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("windows: [", "is not a YAML file"),
        ("just words", "must hold sections such as 'windows:', got 'just words'"),
        ("- 1\n- 2\n", "must hold sections"),
        ("windows:\n", "windows: a section needs settings below it, got None"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, content: str, text: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(content)
    with pytest.raises(ConfigError) as error:
        load_config(file=file)
    assert text in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read settings file .*missing\.yaml: No such"):
        load_config(file=tmp_path / "missing.yaml")
    with pytest.raises(ConfigError, match="cannot read settings file"):
        load_config(file=tmp_path)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match="is not a YAML file"):
        load_config(file=binary)
