"""A map that ends in memory, for a few submaps."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from laser_slam.config import FusionConfig
from laser_slam.fusion.accumulation import Accumulator
from laser_slam.fusion.finishing import Finisher
from laser_slam.fusion.views import automatic_voxel_size
from laser_slam.store import SumFiles, TileFiles, TileIndex
from laser_slam.types import Cloud, Submap


def fuse(submaps: Iterable[Submap], config: FusionConfig) -> Cloud:
    """Average the confident pixels of all owned frames in voxels, each weighted by confidence.

    Every frame counts once, in the window that owns it. Submaps are taken one after the other and
    none is kept. Pixels at depth edges stay out, because depth maps blend both sides there and
    would leave veils of points behind every object.

    Args:
        submaps: in any order; those without depth add nothing.
        config: thresholds; an automatic voxel size follows the first submap with depth.

    Returns:
        The cloud in world units; empty when no pixel was confident.
    """
    sums: Accumulator | None = None
    with TemporaryDirectory() as name:
        folder = Path(name)
        files, aside = TileFiles(folder), SumFiles(folder / "aside")
        size = config.voxel_size
        for submap in submaps:
            size = size or automatic_voxel_size(submap, config) or 0.0
            if sums is None and size:
                sums = Accumulator(aside, config, size)
            if sums is not None:
                sums.add(submap)
        entries = []
        if sums is not None:
            sums.flush()
            entries = Finisher(files, aside, [], config).make(sums.windows)
        files.save_index(TileIndex(size, {}, {}, entries))
        return files.cloud(max(files.num_points, 1))
