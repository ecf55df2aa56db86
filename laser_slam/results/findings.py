"""All that a run found, and its files and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from laser_slam.export import write_ply
from laser_slam.results.keyframes import list_keyframes
from laser_slam.results.loop_pictures import draw_loops
from laser_slam.results.loops import Loops, write_loops
from laser_slam.results.pictures import (
    draw_depth,
    draw_layers,
    draw_map,
    draw_trajectory,
    write_trajectories,
)
from laser_slam.results.scores import Scores
from laser_slam.slam import Node, Slam
from laser_slam.store import TileFiles, WindowFiles
from laser_slam.store.keyframes import save_keyframes
from laser_slam.types import Cloud, Trajectory


@dataclass(frozen=True)
class Findings:
    """What a run found.

    Attributes:
        trajectory: a pose for every frame of the input.
        cloud: the map, in world units; of a large one an even part.
        scores: what the truth says of them.
        loops: what became of the loops; None: they were not looked for.
        truth: poses in metres; None: there is none.
        tiles: the whole map on disk; None: ``cloud`` is the whole.
        raw: what the map would be without filters, thinned; None: it is not drawn.
    """

    trajectory: Trajectory
    cloud: Cloud
    scores: Scores
    loops: Loops | None
    truth: Trajectory | None
    tiles: TileFiles | None = None
    raw: Cloud | None = None

    @property
    def num_points(self) -> int:
        """Return how many points the whole map has."""
        return len(self.cloud.points) if self.tiles is None else self.tiles.num_points


def write_findings(folder: Path, found: Findings, slam: Slam) -> None:
    """Write trajectories, map, keyframes, closures and pose graph into the run's folder.

    Raises:
        RunFolderError: a file cannot be written.
    """
    write_trajectories(folder, found.trajectory, found.truth)
    write_ply(folder / "map.ply", found.cloud if found.tiles is None else found.tiles.clouds)
    save_keyframes(folder, list_keyframes(slam))
    if found.loops is not None:
        write_loops(folder, found.loops, slam)


def draw_findings(
    pictures: Path, found: Findings, nodes: Sequence[Node], files: WindowFiles
) -> None:
    """Draw all pictures of a run.

    Args:
        pictures: folder of the files to be.
        found: by the run.
        nodes: the places of all windows.
        files: where the run's windows are.

    Raises:
        RunFolderError: a picture cannot be written.
    """
    draw_trajectory(pictures, found.trajectory, found.truth, found.scores.trajectory)
    raw = found.raw if found.raw is not None and len(found.raw.points) else None
    draw_map(pictures, found.trajectory, found.cloud, raw)
    draw_depth(pictures, found.scores.views)
    draw_layers(pictures, found.scores.views, nodes)
    if found.loops is not None:
        draw_loops(pictures, found.loops, found.trajectory, nodes, files)
