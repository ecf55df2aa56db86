"""What a run notes of itself: its frames, its warnings, its time by stage."""

from __future__ import annotations

import logging
import threading
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from laser_slam.datasets.base import Dataset
from laser_slam.errors import DatasetError, RunFolderError
from laser_slam.types import Frame

Item = TypeVar("Item")
Progress = Callable[[str, int, int | None], None]
IDLE = ""  # in place of a stage: the thread waits
logger = logging.getLogger(__name__)


def no_progress(stage: str, done: int, total: int | None) -> None:
    """Show nothing."""


def identify(dataset: Dataset) -> dict[str, Any]:
    """Tell this input from others: what is known of it, and its first image's checksum."""
    info = dataset.info
    first = next(iter(dataset.frames()), None)
    if first is None:
        raise DatasetError(f"no frames in {info.name}")
    image = b"" if first.image is None else first.image.tobytes()
    return {
        "name": info.name,
        "size": list(info.size),
        "num_frames": info.num_frames,
        "intrinsics": None if info.intrinsics is None else info.intrinsics.tolist(),
        "intrinsics_source": info.intrinsics_source,
        "first_image_crc32": zlib.crc32(image),
    }


class FrameLog:
    """Remember of the frames that pass what the end of the run needs, and no image."""

    def __init__(self, times_s: Iterable[float] = (), unreadable: Iterable[int] = ()) -> None:
        """Start with what passed before.

        Args:
            times_s: seconds of the frames.
            unreadable: indices of those that could not be read.
        """
        self.times_s = [float(time_s) for time_s in times_s]
        self.unreadable = [int(frame) for frame in unreadable]

    def note(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Pass the frames on."""
        for frame in frames:
            self.times_s.append(frame.time_s)
            if frame.image is None:
                self.unreadable.append(frame.index)
                logger.warning("frame %d cannot be read", frame.index)
            yield frame

    def counts(self) -> dict[str, int]:
        """Return how many frames were read, and how many could not be."""
        return {"read": len(self.times_s), "unreadable": len(self.unreadable)}


class StageClock:
    """Charge wall and CPU seconds to what is under way.

    In each thread that is the innermost stage it is in; what several threads do at the same time
    shares the seconds equally, so that all stages together are the whole.
    """

    def __init__(self) -> None:
        self.wall_s: defaultdict[str, float] = defaultdict(float)
        self.cpu_s: defaultdict[str, float] = defaultdict(float)
        self._lock = threading.Lock()
        self._stages: dict[int, list[str]] = {}  # by thread; IDLE: it waits for another
        self._mark = (time.perf_counter(), time.process_time())

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Charge what happens inside to ``name``, but for the stages inside it."""
        thread = threading.get_ident()
        with self._lock:
            self._charge()
            self._stages.setdefault(thread, []).append(name)
        try:
            yield
        finally:
            with self._lock:
                self._charge()
                self._stages[thread].pop()
                if not self._stages[thread]:
                    del self._stages[thread]

    def idle(self) -> AbstractContextManager[None]:
        """Charge nothing to this thread, which waits for another."""
        return self.stage(IDLE)

    def timed(self, name: str, items: Iterable[Item]) -> Iterator[Item]:
        """Charge the making of the items to ``name``, but not their use."""
        iterator = iter(items)
        while True:
            with self.stage(name):
                try:
                    item = next(iterator)
                except StopIteration:
                    return
            yield item

    def report(self, num_frames: int) -> dict[str, Any]:
        """Return seconds by stage, in all, and frames per second of wall time."""
        with self._lock:
            self._charge()
        total = sum(self.wall_s.values())
        return {
            "seconds": {
                "wall": {stage: round(value, 3) for stage, value in self.wall_s.items()},
                "cpu": {stage: round(value, 3) for stage, value in self.cpu_s.items()},
                "wall_in_all": round(total, 3),
                "cpu_in_all": round(sum(self.cpu_s.values()), 3),
            },
            "frames_per_second": round(num_frames / total, 3),
        }

    def _charge(self) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        busy = [stages[-1] for stages in self._stages.values() if stages[-1] != IDLE] or ["other"]
        for stage in busy:
            self.wall_s[stage] += (wall - self._mark[0]) / len(busy)
            self.cpu_s[stage] += (cpu - self._mark[1]) / len(busy)
        self._mark = (wall, cpu)


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (logging's name)
        """Stay silent on a full disk: the results' files tell, and the log is no reason to stop."""


class _WarningList(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


@contextmanager
def run_log(path: Path) -> Iterator[list[str]]:
    """Write what laser-slam logs to a file too, after what earlier attempts at the run wrote.

    Yields:
        The warnings so far.

    Raises:
        RunFolderError: the file cannot be opened.
    """
    try:
        file = _LogFile(path, encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"cannot write {path}: {error.strerror}") from error
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    warnings = _WarningList()
    package = logging.getLogger("laser_slam")
    level = package.level
    package.setLevel(min(level or logging.INFO, logging.INFO))
    package.addHandler(file)
    package.addHandler(warnings)
    try:
        yield warnings.messages
    finally:
        package.removeHandler(warnings)
        package.removeHandler(file)
        package.setLevel(level)
        file.close()
