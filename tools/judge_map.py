"""Hold the map of a finished run of the generated drive against the true surfaces.

    laser-slam demo --out runs/demo
    python tools/judge_map.py runs/demo
    python tools/judge_map.py runs/demo --only default --set fusion.min_observations=4

The stored windows are fused again for every row of the table; nothing is predicted and nothing in
the run's folder changes. World units become metres by the Sim(3) that aligns the trajectory.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from laser_slam.camera import unproject
from laser_slam.config import Config, load_config
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.datasets.synthetic.paths import loop_path
from laser_slam.datasets.synthetic.world import build_world
from laser_slam.dependencies import import_open3d
from laser_slam.evaluation.trajectory import align
from laser_slam.fusion import Part, TiledMap
from laser_slam.rescoring import read_trajectory
from laser_slam.results.mapping import place_window
from laser_slam.slam import read_window
from laser_slam.store import TileFiles, WindowFiles
from laser_slam.store.keyframes import load_keyframes
from laser_slam.types import Cloud

Array = NDArray[np.float64]

REACH_M = 20.0  # surfaces that a camera saw from closer are to be in the map
NEAR_M = 0.1
MOST_M = 1.0  # a distance beyond it counts as this: one stray point is no kilometre
SAMPLE = 400_000  # points of the map, and of the truth, that are judged
EVERY_FRAME, EVERY_PIXEL = 4, 4  # of the true depth

UNFILTERED = {
    "agreement": 0.0,
    "min_confidence": 0.0,
    "max_range": 1e6,
    "edge_jump": 1e6,
    "min_observations": 1,
}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "every pixel with depth": UNFILTERED,
    **{f"default without {name}": {name: value} for name, value in UNFILTERED.items()},
}


@dataclass(frozen=True)
class Truth:
    """The true surfaces.

    Attributes:
        raycaster: Open3D's scene of all of them.
        seen: (N, 3) points that cameras saw from within ``REACH_M``, metres.
    """

    raycaster: Any
    seen: Array


def make_truth(config: Config, frames: NDArray[np.int64]) -> Truth:
    """Build the world of a drive, and look at it as its cameras did."""
    settings = config.synthetic
    drive = SyntheticDrive(settings)
    path = loop_path(settings.num_frames, settings.step_m, settings.seed)
    world = build_world(path, settings.seed, settings.haze)
    intrinsics = drive.info.intrinsics
    assert intrinsics is not None
    parts = []
    for frame in frames[::EVERY_FRAME]:
        points = unproject(drive.true_depth(int(frame)), intrinsics)
        points = points[::EVERY_PIXEL, ::EVERY_PIXEL].reshape(-1, 3)
        points = points[np.linalg.norm(points, axis=1) < REACH_M]
        pose = world.world_from_cam[frame]
        parts.append(points @ pose[:3, :3].T + pose[:3, 3])
    seen = np.concatenate(parts)
    return Truth(world.raycaster, seen[:: max(1, len(seen) // SAMPLE)])


def judge(cloud: Cloud, truth: Truth) -> dict[str, float]:
    """Compare a cloud in metres, every point of it, with the true surfaces.

    Returns:
        Metres, percent and degrees by their names.
    """
    tensor = import_open3d().core.Tensor
    rows = np.random.default_rng(0).permutation(len(cloud.points))[:SAMPLE]
    points = cloud.points[rows]
    found = truth.raycaster.compute_closest_points(tensor(points.astype(np.float32)))
    off = np.linalg.norm(found["points"].numpy() - points, axis=1).clip(max=MOST_M)
    missing, _ = cKDTree(cloud.points).query(truth.seen, workers=-1)
    missing = missing.clip(max=MOST_M)
    precision, recall = (off < NEAR_M).mean(), (missing < NEAR_M).mean()
    out = {
        "accuracy_cm": 100 * off.mean(),
        "accuracy_p50_cm": 100 * np.median(off),
        "accuracy_p90_cm": 100 * np.percentile(off, 90),
        "precision_%": 100 * precision,
        "completeness_cm": 100 * missing.mean(),
        "recall_%": 100 * recall,
        "chamfer_cm": 50 * (off.mean() + missing.mean()),
        "f_%": 200 * precision * recall / max(precision + recall, 1e-9),
    }
    if cloud.normals is not None:
        is_near = off < NEAR_M
        normals = found["primitive_normals"].numpy()[is_near]
        cosine = np.abs((normals * cloud.normals[rows][is_near]).sum(axis=1)).clip(max=1)
        out["normals_deg"] = float(np.degrees(np.median(np.arccos(cosine))))
    return out


class Run:
    """A finished run of the generated drive.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = load_config(file=folder / "config.yaml")
        self.keyframes = load_keyframes(folder)
        trajectory = read_trajectory(folder / "trajectory_tum.txt", None)
        truth = read_trajectory(folder / "truth_tum.txt", trajectory.times_s)
        self._metres_from_world = align(trajectory, truth, with_scale=True)

    def fuse(self, config: Config) -> Cloud:
        """Make the map anew, in metres."""
        files, indices = WindowFiles(self.folder), np.unique(self.keyframes.windows).tolist()
        with tempfile.TemporaryDirectory() as name:
            tiles = TileFiles(Path(name))
            TiledMap(tiles, config.fusion).update(
                [Part(index, "") for index in indices],
                lambda index: place_window(
                    self.keyframes, index, read_window(files, index, config)
                ),
            )
            cloud = tiles.cloud(10**9)
        placed, normals = self._metres_from_world, cloud.normals
        return Cloud(
            placed.apply(cloud.points),
            cloud.colors,
            cloud.weights,
            cloud.voxel_size * placed.scale,
            None if normals is None else (normals @ placed.rotation.T).astype(np.float32),
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--only", nargs="*", help="names of rows")
    args = parser.parse_args()
    run = Run(args.run)
    config = load_config(file=args.run / "config.yaml", assignments=args.settings)
    truth = make_truth(config, run.keyframes.frames)
    header = False
    for name, changes in VARIANTS.items():
        if args.only and name not in args.only:
            continue
        fusion = config.fusion.model_copy(update=changes)
        cloud = run.fuse(config.model_copy(update={"fusion": fusion}))
        scores = judge(cloud, truth)
        if not header:
            print("| map | points | " + " | ".join(scores) + " |")
            print("|---" * (len(scores) + 2) + "|")
            header = True
        numbers = " | ".join(f"{value:.2f}" for value in scores.values())
        print(f"| {name} | {len(cloud.points):,} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
