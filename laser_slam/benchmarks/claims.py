"""Folders that one process works in at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

from laser_slam.errors import RunFolderError

fcntl: ModuleType | None = None
with suppress(ImportError):  # Windows has none: there, nobody is kept out
    import fcntl


class TakenError(RunFolderError):
    """Another process is working in a folder."""


@contextmanager
def claimed(folder: Path, *, to_read: bool = False) -> Iterator[None]:
    """Keep other processes out of a folder; whatever ends this process lets it go.

    Args:
        folder: made if it is not there, and removed again if it stays empty.
        to_read: others may read it as well.

    Raises:
        TakenError: another process is in it.
        RunFolderError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise RunFolderError(f"cannot use {folder}: {error.strerror}") from error
    try:
        _lock(handle, folder, to_read=to_read)
        try:
            yield
        finally:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path, *, to_read: bool) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if to_read else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise TakenError(f"another process is at work in {folder}") from error
    except OSError:  # a file system without locks
        return
    # Who had it may have removed it as empty since it was opened here.
    if not folder.exists() or not os.path.samestat(os.fstat(handle), folder.stat()):
        raise TakenError(f"another process was at work in {folder}")
