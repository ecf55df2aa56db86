"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from laser_slam.errors import RunFolderError

_ADVICE = {
    errno.ENOSPC: "free some space, or choose another folder",
    errno.EDQUOT: "free some space, or choose another folder",
    errno.EACCES: "make it writable, or choose another folder",
    errno.EROFS: "choose a folder that can be written",
    errno.ENOENT: "create its folder first",
}


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` that becomes ``path`` once it is whole.

    The temporary name ends as ``path`` does, for writers that choose the format by it. Whatever
    goes wrong inside, ``path`` stays as it was and no temporary file remains.

    Raises:
        RunFolderError: the system could not write, flush or rename; says what to do.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        flush(partial)
        partial.replace(path)
    except OSError as error:
        advice = _ADVICE.get(error.errno or 0, "choose another folder")
        reason = error.strerror or str(error)
        raise RunFolderError(f"cannot write {path}: {reason}; {advice}") from error
    finally:
        with suppress(OSError):
            partial.unlink()


def flush(path: Path) -> None:
    """Wait until a file's content is on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, unless it is there.

    Raises:
        RunFolderError: the system could not.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"cannot use {folder}: {error.strerror}; choose another with --out"
        ) from error


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all.

    Names of files that are not UTF-8 are escaped as JSON does it, which gives them back.

    Raises:
        RunFolderError: the system could not write.
    """
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="backslashreplace")
