"""The run folder: made, taken up again, or refused."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from laser_slam.config import Config, dump_config
from laser_slam.errors import RunFolderError
from laser_slam.store.files import write_text


def new_run_folder(name: str, runs: Path = Path("runs")) -> Path:
    """Name a run's folder that is not there yet: ``runs/<name>-<time>``."""
    stem = f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    candidates = (runs / (stem + suffix) for suffix in ["", *(f"-{i}" for i in range(2, 1000))])
    return next(path for path in candidates if not path.exists())


def link_latest(folder: Path) -> None:
    """Let ``latest``, beside the run's folder, link to it; where links cannot be made, skip it."""
    link = folder.parent / "latest"
    partial = folder.parent / f".latest.{os.getpid()}.partial"
    with suppress(OSError):
        partial.symlink_to(folder.name, target_is_directory=True)
        partial.replace(link)
    with suppress(OSError):
        partial.unlink()


def open_run_folder(folder: Path, config: Config, sequence: Mapping[str, Any]) -> bool:
    """Create a run's folder, or take up the one of a run that was broken off.

    Args:
        folder: the run's folder; its parents are created too.
        config: resolved settings of the run.
        sequence: what tells the input from another one; plain YAML values.

    Returns:
        True when a run was broken off here, with the same settings and input.

    Raises:
        RunFolderError: no folder, not writable, not empty, a finished run, or a run with other
            settings or input; names what differs.
    """
    is_resumed = _is_broken_off_run(folder)
    if is_resumed:
        settings = config.model_dump(mode="json")
        _refuse_difference(folder / "config.yaml", settings, "settings")
        _refuse_difference(folder / "sequence.yaml", dict(sequence), "input")
    try:
        (folder / "windows").mkdir(parents=True, exist_ok=True)
        for inner in ("layers", "pictures"):
            (folder / inner).mkdir(exist_ok=True)
        for partial in folder.rglob(".*.partial*"):  # of a run that was killed
            partial.unlink()
    except OSError as error:
        raise RunFolderError(
            f"cannot use {folder} as run folder: {error.strerror}; choose another with --out"
        ) from error
    # The settings come last: a folder that has them is a run.
    write_text(folder / "sequence.yaml", yaml.safe_dump(dict(sequence), sort_keys=False))
    write_text(folder / "config.yaml", dump_config(config))
    return is_resumed


def _is_broken_off_run(folder: Path) -> bool:
    try:
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
        names = {name for name in names if not name.startswith(".")}
    except NotADirectoryError as error:
        raise RunFolderError(f"{folder} is a file; choose a folder with --out") from error
    except OSError as error:
        raise RunFolderError(f"cannot read {folder}: {error.strerror}") from error
    if "report.json" in names:
        raise RunFolderError(
            f"{folder} holds a finished run; choose another folder with --out, or remove this one"
        )
    is_run = {"config.yaml", "sequence.yaml"} <= names
    if not is_run and names - _OF_AN_EARLY_END:
        raise RunFolderError(
            f"{folder} is neither empty nor a run folder; choose another with --out"
        )
    return is_run


_OF_AN_EARLY_END = {"sequence.yaml", "windows", "layers", "pictures", "run.log"}


def _refuse_difference(path: Path, wanted: dict[str, Any], what: str) -> None:
    try:
        stored = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RunFolderError(f"cannot read {path}; remove {path.parent} and run again") from error
    differences = name_differences(stored, wanted)
    if differences:
        raise RunFolderError(
            f"{path.parent} holds a run with other {what}: {differences}; "
            "choose another folder with --out"
        )


def name_differences(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Name the keys in which two nested tables differ, with both values; empty: in none."""
    old, new = dict(_flatten(stored)), dict(_flatten(wanted))
    keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    listed = ", ".join(f"{key} ({old.get(key)}, now {new.get(key)})" for key in keys[:5])
    return listed + (f" and {len(keys) - 5} more" if len(keys) > 5 else "")


def _flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(settings, Mapping):
        yield prefix, settings
        return
    for key, value in settings.items():
        yield from _flatten(value, f"{prefix}.{key}" if prefix else str(key))
