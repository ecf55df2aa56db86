"""A finished run as the export stage wants it."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import Config, load_config
from laser_slam.errors import RunFolderError
from laser_slam.export import DepthView, Photos, Points, Source, survey
from laser_slam.exporting.georeference import place, read_georeference
from laser_slam.exporting.options import ExportOptions
from laser_slam.exporting.photos import Stored, gather_photos, move_originals
from laser_slam.exporting.ply import read_ply
from laser_slam.fusion.views import owned_views
from laser_slam.rescoring import read_trajectory
from laser_slam.sim3 import Sim3
from laser_slam.slam import StoredWindow, read_window
from laser_slam.store import TileFiles, WindowFiles
from laser_slam.store.keyframes import Keyframes, Originals, load_keyframes, load_originals
from laser_slam.types import Cloud, Submap, Trajectory


def open_run(run: Path, options: ExportOptions) -> Source:
    """Open a finished run; what costs time is read when a writer asks for it.

    Raises:
        RunFolderError: the run is not finished, damaged, or of an older version.
        ConfigError: a setting is unknown.
        DatasetError: the geo-reference cannot be read, or fits nothing.
    """
    _refuse_unfinished(run)
    config = load_config(file=run / "config.yaml", assignments=options.assignments)
    opened = _Run(run, config, options)
    trajectory = read_trajectory(run / "trajectory_tum.txt", None)
    projected_from_world = None
    if options.georeference is not None:
        projected_from_world = read_georeference(options.georeference, trajectory)
    graph = run / "graph.g2o"
    return Source(
        str(run),
        config.export,
        trajectory,
        cache(partial(opened.points, projected_from_world)),
        partial(opened.views, trajectory),
        partial(opened.surfaces, trajectory),
        cache(opened.photos),
        graph if graph.exists() else None,
    )


def _refuse_unfinished(run: Path) -> None:
    if (run / "report.json").exists():
        return
    if (run / "config.yaml").exists():
        raise RunFolderError(
            f"the run in {run} is not finished; its command with --out {run} goes on with it"
        )
    raise RunFolderError(f"no run in {run}; give a run folder, such as runs/latest")


@dataclass(frozen=True)
class _Run:
    """The files of a run."""

    folder: Path
    config: Config
    options: ExportOptions
    masks: dict[int, bytes] = field(default_factory=dict)  # of keyframes: a few kB each

    @cached_property
    def keyframes(self) -> Keyframes:
        """Read where the keyframes lie; runs of older versions do not say, and need not."""
        return load_keyframes(self.folder)

    def points(self, projected_from_world: Sim3 | None) -> Points:
        """Look how large the map is."""
        portions = partial(_portions, self.folder)
        if projected_from_world is None:
            return survey(portions)
        placed = partial(_placed, self.folder, projected_from_world)
        return survey(placed, self.options.crs)

    def photos(self) -> Photos:
        """Find the images of the keyframes."""
        originals = self._originals()
        stride = self.config.dataset.stride
        return gather_photos(self.keyframes, self._stored, originals, self.options.photos, stride)

    def views(self, trajectory: Trajectory, wanted: Collection[int] | None) -> Iterator[DepthView]:
        """Read depth maps at their final places."""
        for window, rows in self._windows(wanted):
            for key, row in rows:
                yield self._view(trajectory, window, key, row)

    def surfaces(
        self, trajectory: Trajectory, wanted: Collection[int] | None
    ) -> Iterator[DepthView]:
        """Read depth maps without the pixels that the map leaves out."""
        for window, rows in self._windows(wanted):
            if any(key not in self.masks for key, _ in rows):
                self._filter(window, rows)
            for key, row in rows:
                if key in self.masks:
                    view = self._view(trajectory, window, key, row)
                    is_used = _unpack(self.masks[key], view.depth.shape)
                    depth = np.where(is_used, view.depth, np.float32(np.nan))
                    yield replace(view, depth=depth)

    def _filter(self, window: StoredWindow, rows: Sequence[tuple[int, int]]) -> None:
        """Find the pixels that go into the map, and keep that: it takes most of the time."""
        used = owned_views(_submap(window, [row for _, row in rows]), self.config.fusion)
        for (key, _), filtered in zip(rows, used, strict=False):  # no views: no depth
            self.masks[key] = zlib.compress(np.packbits(filtered.weight > 0).tobytes(), 1)

    def _originals(self) -> Originals:
        originals = load_originals(self.folder)
        if self.options.photos_from is None:
            return originals
        return move_originals(originals, self.options.photos_from)

    def _windows(
        self, wanted: Collection[int] | None
    ) -> Iterator[tuple[StoredWindow, list[tuple[int, int]]]]:
        """Read the windows of some keyframes, with the rows that these have here and there."""
        files = WindowFiles(self.folder)
        for index, rows in groupby(range(len(self.keyframes.frames)), self._owner):
            frames = self.keyframes.frames
            keys = [key for key in rows if wanted is None or int(frames[key]) in wanted]
            if not keys:
                continue
            window = read_window(files, index, self.config)
            found = np.flatnonzero(np.isin(window.raw.frames, frames[keys]))
            if len(found) != len(keys):
                raise RunFolderError(f"window {index} of {self.folder} is of another run")
            yield window, list(zip(keys, found.tolist(), strict=True))

    def _owner(self, key: int) -> int:
        return int(self.keyframes.windows[key])

    def _view(self, trajectory: Trajectory, window: StoredWindow, key: int, row: int) -> DepthView:
        frame = int(self.keyframes.frames[key])
        scale = np.float32(Sim3.from_matrix(self.keyframes.world_from_window[key]).scale)
        return DepthView(
            frame,
            float(trajectory.times_s[frame]),
            window.corrected.depth[row] * scale,
            window.corrected.confidence[row],
            window.colors[row],
            window.corrected.intrinsics[row],
            self.keyframes.world_from_cam[key],
        )

    def _stored(self) -> Iterator[Stored]:
        """Read what the run keeps of the keyframes' images."""
        for window, rows in self._windows(None):
            prediction = window.raw
            size = (prediction.depth.shape[1], prediction.depth.shape[2])
            for key, row in rows:
                yield Stored(
                    int(self.keyframes.frames[key]),
                    prediction.intrinsics[row],
                    size,
                    window.colors[row],
                )


def _unpack(mask: bytes, size: tuple[int, ...]) -> NDArray[np.bool_]:
    bits = np.unpackbits(np.frombuffer(zlib.decompress(mask), np.uint8), count=math.prod(size))
    return bits.astype(np.bool_).reshape(size)


def _submap(window: StoredWindow, rows: Sequence[int]) -> Submap:
    """Join some frames of a window, at no place in particular."""
    is_owned = np.zeros(len(window.raw.frames), np.bool_)
    is_owned[rows] = True
    return Submap(0, window.corrected, window.colors, Sim3(), is_owned, None)


def _placed(run: Path, projected_from_world: Sim3) -> Iterator[Cloud]:
    for cloud in _portions(run):
        yield place(cloud, projected_from_world)


def _portions(run: Path) -> Iterator[Cloud]:
    """Read the map tile by tile, or whole where the run has no tiles."""
    tiles = TileFiles(run / "tiles")
    if tiles.folder.is_dir():
        yield from tiles.clouds()
        return
    yield from read_ply(run / "map.ply", _voxel_size(run / "report.json"))


def _voxel_size(path: Path) -> float:
    try:
        return float(json.loads(path.read_text(encoding="utf-8"))["map"]["voxel_size"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunFolderError(f"{path} is no report of a run; run again") from error
