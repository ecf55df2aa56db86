"""What runs need beside data: asked for before the first of them, not after hours."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from pydantic import BaseModel

from laser_slam.backbones import BACKBONES, ON_CPU, REPLAY, make_backbone
from laser_slam.backbones.base import Backbone
from laser_slam.config import BackboneConfig, Config
from laser_slam.dependencies import import_named
from laser_slam.errors import LaserSlamError
from laser_slam.layers import SEGMENTERS, make_segmenter
from laser_slam.places import BACKBONE, DESCRIPTORS, make_descriptor

logger = logging.getLogger(__name__)


def refuse_unknown_names(config: Config) -> None:
    """Refuse settings that name a backbone, segmenter or descriptor that is none.

    Raises:
        ConfigError: says which there are.
    """
    for table, name, setting, others in (
        (BACKBONES, config.backbone.name, "backbone.name", [REPLAY]),
        (SEGMENTERS, config.layers.segmentation.segmenter, "layers.segmentation.segmenter", []),
        (DESCRIPTORS, config.places.descriptor, "places.descriptor", [BACKBONE]),
    ):
        if name not in {*table, *others}:
            import_named(table, name, setting, others)


class Readiness:
    """The networks of runs: the last one is kept for the next run that wants the same."""

    def __init__(self) -> None:
        self._reasons: dict[str, str | None] = {}
        self._made: tuple[str, Backbone] | None = None

    def check(self, configs: Iterable[Config]) -> None:
        """Try what runs with these settings need, each once, and warn of what cannot be had."""
        for reason in dict.fromkeys(self.why_not(config) for config in configs):
            if reason is not None:
                logger.warning("%s", reason)

    def why_not(self, config: Config) -> str | None:
        """Say why no run can have these settings; None: nothing is in its way."""
        for part, make in self._needs(config):
            key = _as_text(part)
            if key not in self._reasons:
                self._reasons[key] = _why_not(make)
            if self._reasons[key] is not None:
                return self._reasons[key]
        return None

    def backbone(self, config: BackboneConfig) -> Backbone | None:
        """Return a network that any sequence may share; None: each run makes its own.

        Raises:
            LaserSlamError: it cannot be had.
        """
        if config.name in {*ON_CPU, REPLAY}:
            return None
        key = _as_text(config)
        if self._made is None or self._made[0] != key:
            self._made = None  # its memory is needed
            self._made = key, make_backbone(config)
        return self._made[1]

    def _needs(self, config: Config) -> Iterator[tuple[BaseModel, Callable[[], object]]]:
        """Give settings of what a run needs, and how to have it."""
        yield config.backbone, partial(self.backbone, config.backbone)
        if config.has_layers:
            segmentation = config.layers.segmentation
            yield segmentation, partial(make_segmenter, segmentation)
        if config.closures.enabled and config.places.descriptor != BACKBONE:
            yield config.places, partial(make_descriptor, config.places)


def _why_not(make: Callable[[], object]) -> str | None:
    try:
        make()
    except LaserSlamError as error:
        return str(error)
    except (MemoryError, RuntimeError, OSError) as error:  # a GPU's memory is a RuntimeError
        return f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]
    return None


def _as_text(section: BaseModel) -> str:
    return type(section).__name__ + section.model_dump_json()
