"""Folders that appear whole or not at all, and are known as exports."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from laser_slam.errors import RunFolderError
from laser_slam.store.files import flush

MARK = ".laser-slam-export"


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside ``path`` that becomes ``path`` once it is whole.

    An earlier export at ``path`` is replaced. Whatever goes wrong inside, ``path`` stays as it
    was and nothing else remains.

    Raises:
        RunFolderError: the system could not write, or what is at ``path`` is no export.
    """
    check_replaceable(path)
    path = path.resolve()  # "." has no name, and nothing beside it
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    try:
        partial.mkdir()
        yield partial
        (partial / MARK).touch()
        for file in partial.rglob("*"):
            if file.is_file() and not file.is_symlink():
                flush(file)
        _put(partial, path, old)
    except OSError as error:
        raise RunFolderError(
            f"cannot write {path}: {error.strerror or error}; "
            "free some space, or choose another folder"
        ) from error
    finally:
        with suppress(OSError):
            if old.exists() and not path.exists():
                old.replace(path)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _put(partial: Path, path: Path, old: Path) -> None:
    if path.is_dir() and not any(path.iterdir()):
        for entry in list(partial.iterdir()):  # it stays the folder that someone may be in
            entry.replace(path / entry.name)
        return
    if path.exists():
        path.replace(old)
    partial.replace(path)


def check_replaceable(path: Path) -> None:
    """Refuse to replace a folder that no export has made.

    Raises:
        RunFolderError: ``path`` is there and is no earlier export.
    """
    if path.is_dir() and not (path / MARK).exists() and any(path.iterdir()):
        raise RunFolderError(
            f"{path} was not made by an export, so it is not replaced; choose another with --out"
        )
