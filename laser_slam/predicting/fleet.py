"""Windows spread over many GPUs or machines: each is predicted by whoever is free."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.backbones import make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.config import BackboneConfig
from laser_slam.dependencies import import_ray, num_threads
from laser_slam.errors import ConfigError, LaserSlamError
from laser_slam.predicting.backbone_source import BackboneSource
from laser_slam.predicting.cluster import Fleet, connect, divide, last_line
from laser_slam.rectification import reduce_images
from laser_slam.store import name_differences, pack_window
from laser_slam.types import Window

# Windows in a row that go to one worker, where the backbone remembers: it starts afresh with each
# stretch, whoever does it, so that the outcome does not depend on how many workers there are.
STRETCH = 8
MAX_TRIES = 3  # workers that may be lost over the same windows
START_S = 600.0  # a worker may have to fetch gigabytes of weights
LATE_S = 60.0  # that those who came wait for the rest, who may come later still
QUEUED = 2  # stretches per worker, so that none waits for the next
logger = logging.getLogger(__name__)


@dataclass
class _Task:
    """Windows in a row, until their predictions are stored."""

    windows: list[Window]
    num_tries: int = 0


class Worker:
    """What runs in a process of its own, perhaps on another machine."""

    def __init__(self, config: BackboneConfig) -> None:
        cv2.setNumThreads(num_threads())
        self._config = config

    @cached_property
    def backbone(self) -> Backbone:
        """The source of depth and poses, made when it is first needed."""
        return make_backbone(self._config)

    def identity(self) -> dict[str, Any]:
        """Return what its predictions depend on beside the images."""
        return self.backbone.identity()

    def process(self) -> int:
        """Return the number of the process that it runs in."""
        return os.getpid()

    def predict(self, windows: list[Window], intrinsics: NDArray[np.float64] | None) -> list[bytes]:
        """Predict windows in a row, as if there were no others; return their files' contents."""
        if self.backbone.remembers:
            del self.backbone
        files = []
        for window in windows:
            prediction = self.backbone.predict(window.images, window.frames, intrinsics)
            colors = reduce_images(window.images, prediction.depth.shape[1:])
            files.append(pack_window(prediction, colors))
        return files


class Crew:
    """The workers of a fleet, and what each is doing.

    Attributes:
        workers: handles of the processes.
        identity: what predictions of all of them depend on beside the images; empty: not yet known.
    """

    def __init__(self, fleet: Fleet, config: BackboneConfig) -> None:
        """Prepare; workers start where the crew is entered, in Ray if it runs here already.

        Args:
            fleet: which.
            config: of the backbone.

        Raises:
            DependencyError: Ray is not installed.
        """
        self._ray = import_ray()
        self._fleet = fleet
        self._config = config
        self._options: dict[str, float] = {}
        self._is_guest = self._ray.is_initialized()
        self._tasks: dict[Any, tuple[Any, _Task]] = {}  # what comes of it -> worker, task
        self._coming: dict[Any, Any] = {}  # what it will say of itself -> worker
        self.identity: dict[str, Any] = {}
        self.workers: list[Any] = []

    def __enter__(self) -> Crew:
        """Start the workers and wait for them; those that would predict otherwise are refused."""
        if not self._is_guest:
            connect(self._ray, self._fleet.address)
        try:
            nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
            self._options, num = divide(nodes, self._fleet, self._config)
            for _ in range(num):
                self._start()
            self._await_one()
            while self._coming and self._admit(LATE_S):
                pass
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Let all workers go."""
        for worker in [*self.workers, *self._coming.values()]:
            self._ray.kill(worker)
        if not self._is_guest:
            self._ray.shutdown()

    def predict(
        self, stretches: Iterable[list[Window]], intrinsics: NDArray[np.float64] | None
    ) -> Iterator[tuple[list[Window], list[bytes]]]:
        """Give windows with their files' contents, in the order in which they are done.

        What a lost worker had is given to others; where there is room, another takes its place.

        Args:
            stretches: windows in a row; a few more are taken than there are workers.
            intrinsics: (3, 3) in pixels of the images; None: unknown.

        Raises:
            LaserSlamError: a backbone refused, or workers are lost again and again.
        """
        for stretch in stretches:
            self._give(_Task(stretch), intrinsics)
            while len(self._tasks) >= QUEUED * len(self.workers):
                yield from self._collect(intrinsics)
        while self._tasks:
            yield from self._collect(intrinsics)

    def _start(self) -> None:
        worker = self._ray.remote(Worker).options(**self._options).remote(self._config)
        self._coming[worker.identity.remote()] = worker

    def _await_one(self) -> None:
        """Wait until there is a worker."""
        while not self.workers:
            if not self._coming or not self._admit(START_S):
                raise LaserSlamError(
                    f"no worker came in {START_S:.0f} s; see Ray's log, and whether any machine "
                    f"has {self._options}; what is predicted is kept"
                )

    def _admit(self, timeout_s: float) -> bool:
        """Wait for one of those that come; False: none came in time."""
        done, _ = self._ray.wait(list(self._coming), num_returns=1, timeout=timeout_s)
        for said in done:
            self._welcome(said)
        return bool(done)

    def _welcome(self, said: Any) -> None:
        """Take a worker on, and refuse one that would predict otherwise than the others."""
        worker = self._coming.pop(said)
        try:
            found = self._ray.get(said)
        except self._lost() as error:
            logger.warning("a worker did not start: %s", last_line(error))
            return
        except self._ray.exceptions.RayError as error:
            raise _cause(error) from error
        self.identity = self.identity or found
        self.workers.append(worker)
        if found != self.identity:
            raise ConfigError(
                f"a worker has another backbone than the others: "
                f"{name_differences(self.identity, found)}; give all machines the same weights "
                "and the same kind of device, or set dtype"
            )

    def _lost(self) -> tuple[type[Exception], ...]:
        """Return what is raised of a worker whose process or machine is gone."""
        errors = self._ray.exceptions
        return errors.RayActorError, errors.OutOfMemoryError, errors.NodeDiedError

    def _give(self, task: _Task, intrinsics: NDArray[np.float64] | None) -> None:
        self._await_one()
        load = {id(worker): 0 for worker in self.workers}
        for worker, _ in self._tasks.values():
            load[id(worker)] = load.get(id(worker), 0) + 1
        worker = min(self.workers, key=lambda each: load[id(each)])
        self._tasks[worker.predict.remote(task.windows, intrinsics)] = (worker, task)

    def _collect(
        self, intrinsics: NDArray[np.float64] | None
    ) -> Iterator[tuple[list[Window], list[bytes]]]:
        """Wait until something is done, or lost, or a worker comes."""
        done, _ = self._ray.wait([*self._tasks, *self._coming], num_returns=1)
        for each in done:
            if each in self._coming:
                self._welcome(each)
                continue
            worker, task = self._tasks.pop(each)
            try:
                files = self._ray.get(each)
            except self._lost() as error:
                self._let_go(worker, task, error)
                self._give(task, intrinsics)
            except self._ray.exceptions.RayError as error:
                raise _cause(error) from error
            else:
                yield task.windows, files

    def _let_go(self, worker: Any, task: _Task, error: Exception) -> None:
        """Do without a worker; ask for another, who comes if there is room."""
        task.num_tries += 1
        first, last = task.windows[0].index, task.windows[-1].index
        if task.num_tries == MAX_TRIES:
            raise LaserSlamError(
                f"{MAX_TRIES} workers were lost over windows {first} to {last} "
                f"({last_line(error)}); see Ray's log; give each more memory, or lower windows.size"
            ) from error
        logger.warning("a worker was lost; windows %d to %d are done again", first, last)
        if worker in self.workers:
            self.workers.remove(worker)
            self._ray.kill(worker)
            self._start()


def spread(source: BackboneSource, crew: Crew) -> Iterator[list[Window]]:
    """Predict what is missing of a source's windows; the same files, whoever makes them.

    Args:
        source: calibrated; what it has files of is left as it is.
        crew: of workers.

    Yields:
        Windows in a row whose files are there now, those left as they were included.
    """
    frames: dict[int, list[int]] = {}
    waiting: list[list[Window]] = []

    def missing() -> Iterator[list[Window]]:
        with closing(source.cut()) as windows:
            for stretch in _stretches(windows, STRETCH if source.remembers else 1):
                frames.update({window.index: window.frames.tolist() for window in stretch})
                if all(source.files.has(window.index) for window in stretch):
                    waiting.append(stretch)
                else:
                    yield stretch

    for stretch, files in crew.predict(missing(), source.rectifier.intrinsics):
        for window, content in zip(stretch, files, strict=True):
            source.files.write(window.index, content)
        yield from [*waiting, stretch]
        waiting.clear()
    yield from waiting
    source.finish([frames[index] for index in sorted(frames)])


def _stretches(windows: Iterable[Window], length: int) -> Iterator[list[Window]]:
    stretch: list[Window] = []
    for window in windows:
        stretch.append(window)
        if len(stretch) == length:
            yield stretch
            stretch = []
    if stretch:
        yield stretch


def _cause(error: Exception) -> Exception:
    """Return what went wrong in a worker: our own errors as they are."""
    cause = getattr(error, "cause", None)
    if isinstance(cause, LaserSlamError):
        return cause
    return LaserSlamError(f"a worker failed: {last_line(error)}; see Ray's log")
