"""Where a recording goes: a file, a viewer on this screen, a browser."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from laser_slam.dependencies import import_rerun
from laser_slam.errors import LaserSlamError, RunFolderError

FLUSH_S = 20.0  # a viewer that takes nothing for so long is gone


class Sink(Protocol):
    """A recording and its way out.

    Attributes:
        stream: rerun's, to log to.
    """

    @property
    def stream(self) -> Any:
        """Return rerun's recording stream."""

    def open(self) -> None:
        """Begin, before anything is logged."""

    def flush(self) -> None:
        """Pass on what was logged so far.

        Raises:
            LaserSlamError: it cannot be; nothing more can be shown.
        """

    def close(self) -> None:
        """Pass on the rest and end."""


def has_display() -> bool:
    """Tell whether a window can be opened here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class FileSink:
    """A recording in a file that rerun's viewers open, also while it grows.

    Args:
        path: of the file, ``*.rrd``, which is made when the first window comes.
        replace: what is at ``path`` already.
    """

    def __init__(self, path: Path, *, replace: bool = False) -> None:
        self.path = path
        self.stream = _new_stream()
        self._replace = replace
        self._is_begun = False  # what is at the path is this recording

    def open(self) -> None:
        """Begin the file.

        Raises:
            RunFolderError: it cannot be written, or something is there that is not to be replaced.
        """
        self.refuse_existing()
        with self._writing():
            self.stream.save(self.path)
            self._is_begun = True

    def refuse_existing(self) -> None:
        """Refuse to write over what nobody asked to replace.

        Raises:
            RunFolderError: something is at ``path``.
        """
        if not self._replace and self.path.exists():
            raise RunFolderError(
                f"{self.path} is there already; replace it with --force, or choose another file "
                "with --save"
            )

    def flush(self) -> None:
        """Append what was logged so far.

        Raises:
            RunFolderError: it cannot be written; it is removed, for a full disk's sake.
        """
        with self._writing():
            self.stream.flush()

    def close(self) -> None:
        """Append the rest, and the index by which viewers find their way in it."""
        self.flush()
        self.stream.disconnect()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except (RuntimeError, OSError) as error:
            if self._is_begun and self.path.is_file():
                self.path.unlink()
            reason = str(error).partition(", path:")[0]
            raise RunFolderError(
                f"cannot write the recording {self.path}: {reason}; free some space or choose "
                "another place: laser-slam view RUN --save FILE"
            ) from error


class WindowSink:
    """A recording that rerun's viewer shows in a window of its own.

    Raises:
        LaserSlamError: the viewer does not start.
    """

    def __init__(self) -> None:
        rerun = import_rerun()
        self.stream = _new_stream()
        options = {"executable_path": _executable(), "hide_welcome_screen": True}
        try:
            rerun.spawn(recording=self.stream, **options)
        except (RuntimeError, OSError) as error:
            raise LaserSlamError(
                f"rerun's viewer does not start ({error}); write a recording instead: "
                "laser-slam view RUN --save FILE"
            ) from error

    def open(self) -> None:
        """Do nothing: the viewer is there."""

    def flush(self) -> None:
        """Pass on what was logged so far.

        Raises:
            LaserSlamError: the viewer is gone.
        """
        try:
            self.stream.flush(timeout_sec=FLUSH_S)
        except (RuntimeError, ValueError) as error:
            raise LaserSlamError("rerun's viewer was closed or does not answer") from error

    def close(self) -> None:
        """Pass on the rest; the window stays."""
        self.flush()


class BrowserSink:
    """A recording that browsers show; this process serves it and must go on running.

    Args:
        port: of the page; the data come from the port after it.

    Raises:
        LaserSlamError: a port is taken.
    """

    def __init__(self, port: int) -> None:
        rerun = import_rerun()
        self.stream = _new_stream()
        try:
            uri = self.stream.serve_grpc(grpc_port=port + 1, server_memory_limit="50%")
            rerun.serve_web_viewer(web_port=port, open_browser=False, connect_to=uri)
        except (RuntimeError, OSError, ValueError) as error:
            raise LaserSlamError(
                f"cannot serve on ports {port} and {port + 1} ({error}); choose another --port"
            ) from error
        self.url = f"http://localhost:{port}/?url={uri.replace('+', '%2B')}"

    def open(self) -> None:
        """Do nothing: the page is there."""

    def flush(self) -> None:
        """Pass on what was logged so far."""
        self.stream.flush(timeout_sec=FLUSH_S)

    def close(self) -> None:
        """Pass on the rest; served until the process ends."""
        self.flush()

    def wait(self) -> None:
        """Serve until someone interrupts."""
        with suppress(KeyboardInterrupt):
            threading.Event().wait()


def _new_stream() -> Any:
    rerun = import_rerun()
    stream = rerun.RecordingStream("laser_slam")
    # Frame and time of the drive tell all; when it was logged would be a third of small records.
    stream.set_log_tick_enabled(False)
    stream.set_log_time_enabled(False)
    return stream


def _executable() -> str | None:
    """Return rerun's viewer of this environment, which need not be activated."""
    beside = Path(sys.executable).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")
    return str(beside) if beside.exists() else None
