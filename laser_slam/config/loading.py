"""Settings in layers: code, shipped file, the user's file, assignments."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from laser_slam.config.sections import Config
from laser_slam.errors import ConfigError


def load_config(
    name: str | None = None,
    file: Path | None = None,
    assignments: Sequence[str] = (),
    base: Mapping[str, Any] | None = None,
) -> Config:
    """Layer the settings: code < ``configs/<name>.yaml`` < ``file`` < ``key=value`` assignments.

    A ``preset`` among them names a shipped file that is laid under all of these, over ``base``.

    Args:
        name: of a settings file that ships with laser-slam, such as ``kitti``.
        file: a settings file of the user's.
        assignments: ``section.key=value``, the value in YAML.
        base: nested settings in the place of the code's own; None: these.

    Raises:
        ConfigError: a file is missing or no YAML, a setting is unknown or out of its limits.

    >>> load_config(assignments=["windows.size=30"]).windows.size
    30
    """
    given: dict[str, Any] = {}
    if name is not None:
        _merge(given, _read_shipped(name))
    if file is not None:
        _merge(given, _read_yaml(file))
    _merge(given, assigned(assignments))
    settings: dict[str, Any] = copy.deepcopy(dict(base or {}))
    preset = given.get("preset", settings.get("preset"))
    if isinstance(preset, str) and preset:
        _merge(settings, _read_preset(preset))
    _merge(settings, given)
    return _validate(settings)


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Nest ``section.key=value`` assignments, later ones over earlier ones.

    Raises:
        ConfigError: one is no assignment.

    >>> assigned(["windows.size=30", "windows.overlap=7"])
    {'windows': {'size': 30, 'overlap': 7}}
    """
    settings: dict[str, Any] = {}
    for assignment in assignments:
        _merge(settings, _parse_assignment(assignment))
    return settings


def shipped_configs() -> Path:
    """Return the folder of the settings files that ship with laser-slam."""
    installed = Path(__file__).parents[1] / "configs"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def dump_config(config: Config) -> str:
    """Write all settings as YAML, defaults included."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def setting_names(model: type[BaseModel] = Config, prefix: str = "") -> Iterator[str]:
    """List every setting as ``section.key``."""
    for key, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from setting_names(field.annotation, f"{prefix}{key}.")
        else:
            yield prefix + key


def _validate(settings: dict[str, Any]) -> Config:
    try:
        return Config.model_validate(settings)
    except ValidationError as error:
        raise ConfigError("; ".join(_explain(dict(item)) for item in error.errors())) from error


def _explain(item: dict[str, Any]) -> str:
    name = ".".join(str(part) for part in item["loc"])
    given = item["input"]
    if item["type"] == "extra_forbidden":
        return _explain_unknown(name, given)
    if item["type"] == "model_type":
        return f"{name}: a section needs settings below it, got {given!r}"[:300]
    text = str(item["msg"]).removeprefix("Value error, ")
    # A validator of ours has said what it got.
    got = "" if item["type"] == "value_error" else f", got {given!r}"
    return f"{name}: {text[0].lower()}{text[1:]}{got}"[:300]


def _explain_unknown(name: str, given: Any) -> str:
    while isinstance(given, dict) and len(given) > 0:
        key, given = next(iter(given.items()))
        name += f".{key}"
    known = list(setting_names())
    same_end = [other for other in known if other.endswith("." + name.rpartition(".")[2])]
    near = difflib.get_close_matches(name, known, n=1) or same_end
    return f"{name}: no such setting" + (f" (did you mean {near[0]}?)" if near else "")


def _shipped_names() -> list[str]:
    return sorted(path.stem for path in shipped_configs().glob("*.yaml"))


def _read_preset(name: str) -> dict[str, Any]:
    names = _shipped_names()
    if name not in names:
        raise ConfigError(f"preset: no '{name}'; there is {', '.join(names)}")
    return _read_shipped(name)


def _read_shipped(name: str) -> dict[str, Any]:
    names = _shipped_names()
    if name not in names:
        raise ConfigError(f"no settings named '{name}'; there are: {', '.join(names)}")
    return _read_yaml(shipped_configs() / f"{name}.yaml")


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read settings file {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path} must hold sections such as 'windows:', got {content!r:.60}")
    return content


def _parse_assignment(assignment: str) -> dict[str, Any]:
    name, equals, value = assignment.partition("=")
    if not equals or not all(name.strip().split(".")):
        raise ConfigError(f"--set wants section.key=value, got '{assignment}'")
    try:
        settings: Any = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise ConfigError(f"{name}: '{value}' is no YAML value") from error
    for key in reversed(name.strip().split(".")):
        settings = {key: settings}
    return dict(settings)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> None:
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            _merge(base[key], value)
        else:
            base[key] = value
