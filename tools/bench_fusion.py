"""Time and memory of fusion, on a generated drive through a town of square blocks.

The drive is made window by window while it is fused: nothing but the map is on disk. Each length
runs in a process of its own, so that the peak of its memory is its own.

    python tools/bench_fusion.py --frames 908 4541
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laser_slam.camera import intrinsics_matrix
from laser_slam.config import FusionConfig
from laser_slam.export import write_ply
from laser_slam.fusion import Part, TiledMap
from laser_slam.sim3 import Sim3
from laser_slam.store import TileFiles
from laser_slam.types import Prediction, Submap

Array = NDArray[np.float64]

SIZE = (154, 518)
INTRINSICS = intrinsics_matrix(300.0, 300.0, 258.5, 72.0)  # KITTI's at this size
BLOCK_M, HALF_STREET_M = 100.0, 8.0
STEP_M = 3724 / 4541  # as in KITTI 00
CAMERA_M, HOUSE_M = 1.65, 9.0
OWNED, SHARED = 15, 5
GRID = 5  # crossings a side: at KITTI 00's length, streets come twice


def drive(num: int) -> Array:
    """Return (num, 3): x, z in metres and heading in radians; turns are arcs over crossings."""
    rng = np.random.default_rng(0)
    steps = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    at, direction, points = np.array([0, 0]), 0, [np.zeros(2)]
    while len(points) * BLOCK_M < num * STEP_M + 2 * BLOCK_M:
        turns = [(direction + turn) % 4 for turn in (0, 1, 3)]
        possible = [k for k in turns if ((at + steps[k] >= 0) & (at + steps[k] < GRID)).all()]
        direction = int(rng.choice(possible))
        at = at + steps[direction]
        points.append(at * BLOCK_M)
    corners = np.array(points)
    ends = np.concatenate([corners[:-1] * 0.93 + corners[1:] * 0.07, corners[1:]], axis=1)
    path = np.concatenate([np.stack([e[:2], 0.93 * e[2:] + 0.07 * e[:2]]) for e in ends])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at_m = np.arange(num) * STEP_M
    x, z = (np.interp(at_m, along, path[:, k]) for k in range(2))
    kernel = np.ones(9) / 9  # what a driver makes of corners
    x, z = (np.convolve(np.pad(c, 4, "edge"), kernel, "valid") for c in (x, z))
    heading = np.arctan2(np.gradient(x), np.gradient(z))
    return np.stack([x, z, heading], axis=1)


@njit(cache=True)
def _walls(x: float, z: float, heading: float, slopes: Any, most: float) -> Any:
    """Return the depth of the first house in each column, by marching."""
    out = np.empty(len(slopes))
    for column in range(len(slopes)):
        dx = np.sin(heading) + slopes[column] * np.cos(heading)
        dz = np.cos(heading) - slopes[column] * np.sin(heading)
        depth, step = 1.0, 0.25
        while depth < most:
            px, pz = x + depth * dx, z + depth * dz
            qx = abs((px + BLOCK_M / 2) % BLOCK_M - BLOCK_M / 2)
            qz = abs((pz + BLOCK_M / 2) % BLOCK_M - BLOCK_M / 2)
            bay = 0.6 * (int(np.floor(px / 4)) + int(np.floor(pz / 4))) % 2
            if qx > HALF_STREET_M + bay and qz > HALF_STREET_M + bay:
                break
            depth += step
        out[column] = depth - 0.5 * step
    return out


class Town:
    """Submaps of a drive, each made when it is asked for."""

    def __init__(self, num_frames: int) -> None:
        self.poses = drive(num_frames)
        self.num_windows = -(-num_frames // OWNED)
        rng = np.random.default_rng(1)
        self._noise = rng.normal(size=(8, *SIZE)).astype(np.float32)
        self._colors = rng.integers(60, 200, (OWNED + SHARED, *SIZE, 3), dtype=np.uint8)
        v, u = np.mgrid[: SIZE[0], : SIZE[1]]
        self._slopes = (u[0] - INTRINSICS[0, 2]) / INTRINSICS[0, 0]
        self._down = (v - INTRINSICS[1, 2]) / INTRINSICS[1, 1]
        self.seconds = 0.0

    def submap(self, index: int) -> Submap:
        """Make a window of 20 frames, of which it owns 15; world and window unit: metres."""
        start = time.process_time()
        rows = np.arange(index * OWNED, min(index * OWNED + OWNED + SHARED, len(self.poses)))
        depth = np.stack([self._depth(int(row)) for row in rows])
        prediction = Prediction(
            frames=rows,
            depth=depth,
            confidence=np.where(np.isfinite(depth), np.float32(0.8), np.float32(0)),
            window_from_cam=np.stack([_pose(self.poses[row]) for row in rows]),
            intrinsics=np.tile(INTRINSICS, (len(rows), 1, 1)),
        )
        is_owned = rows < (index + 1) * OWNED
        self.seconds += time.process_time() - start
        return Submap(index, prediction, self._colors[: len(rows)], Sim3(), is_owned, None)

    def _depth(self, row: int) -> NDArray[np.float32]:
        x, z, heading = self.poses[row]
        wall = np.broadcast_to(_walls(x, z, heading, self._slopes, 80.0), SIZE)
        with np.errstate(divide="ignore"):
            road = np.where(self._down > 0, CAMERA_M / self._down, np.inf)
        depth = np.minimum(wall, road)
        depth[(depth > 79) | (-depth * self._down > HOUSE_M - CAMERA_M)] = np.nan
        noise = 0.004 * self._noise[row % 8] + 0.01 * np.sin(row + self._slopes * 9)
        return np.asarray(depth * (1 + noise), np.float32)


def _pose(pose: Array) -> Array:
    x, z, heading = pose
    out = np.eye(4)
    out[0, :3] = [np.cos(heading), 0, np.sin(heading)]
    out[2, :3] = [-np.sin(heading), 0, np.cos(heading)]
    out[[0, 2], 3] = [x, z]
    return out


def measure(num_frames: int, config: FusionConfig) -> dict[str, Any]:
    """Fuse a drive, write it as PLY, take what pictures need; tell what it took."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        TiledMap(TileFiles(folder / "warm"), config).update(
            [Part(0, "")], Town(20).submap
        )  # compiles
        town, files = Town(num_frames), TileFiles(folder / "tiles")
        parts = [Part(index, "") for index in range(town.num_windows)]
        before_mib, start, wall = _rss_mib(), time.process_time(), time.perf_counter()
        TiledMap(files, config).update(parts, town.submap)
        out = {
            "frames": num_frames,
            "input_points": num_frames * SIZE[0] * SIZE[1],
            "map_points": files.num_points,
            "voxels": sum(entry.num_voxels for entry in files.index().tiles),
            "tiles": len(files.index().tiles),
            "cpu_s": time.process_time() - start - town.seconds,
            "wall_s": time.perf_counter() - wall - town.seconds,
            "before_mib": before_mib,
            "fused_mib": _rss_mib(),
            "disk_mib": sum(p.stat().st_size for p in files.folder.iterdir()) / 2**20,
        }
        start = time.process_time()
        write_ply(folder / "map.ply", files.clouds)
        out |= {"ply_s": time.process_time() - start, "ply_mib": _rss_mib()}
        out["ply_disk_mib"] = (folder / "map.ply").stat().st_size / 2**20
        out["cloud_points"] = len(files.cloud(config.cloud_points).points)
        return out | {"cloud_mib": _rss_mib()}


def _rss_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def main() -> None:
    """Measure each length in a process of its own and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[908, 4541])
    parser.add_argument("--set", dest="settings", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--alone", action="store_true", help="measure in this process")
    args = parser.parse_args()
    settings = dict(item.split("=", 1) for item in args.settings)
    if args.alone:
        config = FusionConfig.model_validate(settings)
        print(json.dumps(measure(args.frames[0], config)))
        return
    for frames in args.frames:
        command = [sys.executable, __file__, "--alone", "--frames", str(frames), "--set"]
        text = subprocess.run([*command, *args.settings], check=True, stdout=subprocess.PIPE)
        found = json.loads(text.stdout)
        print("  ".join(f"{key} {_short(value)}" for key, value in found.items()), flush=True)


def _short(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:.1f}"


if __name__ == "__main__":
    main()
