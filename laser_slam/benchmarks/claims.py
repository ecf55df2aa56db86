"""Folders that one process works in at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

from laser_slam.errors import RunFolderError
from laser_slam.store.files import make_folder

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
    make_folder(folder)
    with _locked(folder, to_read=to_read):
        try:
            yield
        finally:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


@contextmanager
def _locked(folder: Path, *, to_read: bool) -> Iterator[None]:
    if fcntl is None:  # nor can a folder be opened there
        yield
        return
    try:
        handle = os.open(folder, os.O_RDONLY)
    except FileNotFoundError as error:  # who had it has just removed it as empty
        raise TakenError(f"another process was at work in {folder}") from error
    except OSError as error:
        raise RunFolderError(f"cannot use {folder}: {error.strerror}") from error
    try:
        _lock(fcntl, handle, folder, to_read=to_read)
        yield
    finally:
        os.close(handle)


def _lock(fcntl: ModuleType, handle: int, folder: Path, *, to_read: bool) -> None:
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if to_read else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise TakenError(f"another process is at work in {folder}") from error
    except OSError:  # a file system without locks
        return
    # Who had it may have removed it as empty since it was opened here.
    is_there = False
    with suppress(FileNotFoundError):
        is_there = os.path.samestat(os.fstat(handle), folder.stat())
    if not is_there:
        raise TakenError(f"another process was at work in {folder}")
