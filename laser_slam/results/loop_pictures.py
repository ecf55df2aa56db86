"""The pictures of a run's loops."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np
import PIL.Image

from laser_slam.closures import ClosureRecord
from laser_slam.evaluation.trajectory import path_distances
from laser_slam.report import (
    ImagePair,
    LoopPaths,
    ScaleCurves,
    frame_pairs,
    loops_picture,
    pairs_picture,
    scales_picture,
    similarity_picture,
)
from laser_slam.results.loops import Loops
from laser_slam.results.paths import on_truth
from laser_slam.slam import Node
from laser_slam.store import WindowFiles, atomic_write
from laser_slam.types import Image, Trajectory

MAX_PAIRS = 12  # on the sheet of image pairs
MAX_THUMBNAILS = 24  # pairs of small images beside the table of loops
_THUMBNAIL_PX = 320


def draw_loops(
    pictures: Path,
    loops: Loops,
    trajectory: Trajectory,
    nodes: Sequence[Node],
    files: WindowFiles,
) -> None:
    """Draw the loops, the images of some candidates, similarities, and the windows' scales.

    Args:
        pictures: folder of the files to be.
        loops: what became of them.
        trajectory: a pose for every frame, with the loops closed.
        nodes: the places of all windows.
        files: where the run's windows are.

    Raises:
        RunFolderError: a picture cannot be written.
    """
    accepted, rejected = (
        frame_pairs([(r.frame_a, r.frame_b) for r in loops.records if r.is_accepted == is_accepted])
        for is_accepted in (True, False)
    )
    path, found = pictures / "similarity.png", loops.similarities
    similarity_picture(path, found.similarities, found.frames, found.per_cell, accepted, rejected)
    (chained, closed), truth, scales = on_truth([loops.chained, trajectory], loops.truth)
    if len(loops.records):
        paths = LoopPaths(chained, closed, truth, accepted, rejected)
        loops_picture(pictures / "loops.png", paths)
        shown = choose_pairs(loops.records, MAX_PAIRS)
        title = f"{len(shown)} of {len(loops.records)} candidates"
        pairs_picture(pictures / "loop_pairs.png", _image_pairs(shown, files), title)
        write_thumbnails(pictures, choose_pairs(loops.records, MAX_THUMBNAILS), files)
    scales_picture(
        pictures / "scales.png", scale_curves(nodes, closed, truth, (scales[0], scales[1]))
    )


def choose_pairs(records: Sequence[ClosureRecord], num: int) -> list[ClosureRecord]:
    """Take up to ``num`` records spread over the run, as many accepted as rejected if there are.

    >>> records = [ClosureRecord(0, 9, i, 90 + i, 0.5, "accepted") for i in range(20)]
    >>> [record.frame_a for record in choose_pairs(records, 3)]
    [0, 10, 19]
    """
    accepted = [record for record in records if record.is_accepted]
    rejected = [record for record in records if not record.is_accepted]
    num_rejected = min(len(rejected), max(num // 2, num - len(accepted)))
    chosen = [
        part[k]
        for part, count in ((accepted, num - num_rejected), (rejected, num_rejected))
        for k in np.unique(np.linspace(0, len(part) - 1, min(count, len(part))).round().astype(int))
    ]
    return chosen


def thumbnail(pictures: Path, frame: int) -> Path:
    """Name the small image of a frame among a run's pictures."""
    return pictures / "frames" / f"{frame:06d}.jpg"


def write_thumbnails(pictures: Path, records: Sequence[ClosureRecord], files: WindowFiles) -> None:
    """Write a small image of each frame of the records, each window being read once.

    Raises:
        RunFolderError: an image cannot be written.
    """
    ends = {(r.window_a, r.frame_a) for r in records} | {(r.window_b, r.frame_b) for r in records}
    for window, members in groupby(sorted(ends), key=itemgetter(0)):
        prediction, colors = files.load(window)
        for _, frame in members:
            row = int(np.searchsorted(prediction.frames, frame))
            small = PIL.Image.fromarray(colors[row])
            small.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
            path = thumbnail(pictures, frame)
            with atomic_write(path) as partial:
                path.parent.mkdir(exist_ok=True)
                small.save(partial, "JPEG", quality=80)


def scale_curves(
    nodes: Sequence[Node],
    closed: Trajectory,
    truth: Trajectory | None,
    unit_per_world: tuple[float, float],
) -> ScaleCurves:
    """Return the scales of the windows with a frame of their own, along the path.

    Args:
        nodes: the places of all windows.
        closed: a pose for every frame, in the unit of the distances.
        truth: poses in metres; None: there is none.
        unit_per_world: that unit per world unit, without loops and with them.
    """
    used = [node for node in nodes if node.is_owned.any()]
    middles = [node.frames[node.is_owned][node.is_owned.sum() // 2] for node in used]
    distances = path_distances(closed)[np.searchsorted(closed.frames, middles)]
    return ScaleCurves(
        distances,
        unit_per_world[0] * np.array([node.chained.scale for node in used]),
        unit_per_world[1] * np.array([node.world_from_window.scale for node in used]),
        None if truth is None else np.array([_true_scale(node, truth) for node in used]),
    )


def _true_scale(node: Node, truth: Trajectory) -> float:
    """Return metres per window unit, by how far the camera centres are spread; NaN: unknown."""
    _, in_window, in_truth = np.intersect1d(node.frames, truth.frames, return_indices=True)
    if len(in_window) < 2:
        return float("nan")
    found, true = (
        float(np.linalg.norm(centers - centers.mean(axis=0)))
        for centers in (
            node.window_from_cam[in_window, :3, 3],
            truth.world_from_cam[in_truth, :3, 3],
        )
    )
    return true / found if found > 0 and true > 0 else float("nan")


def _image_pairs(records: Sequence[ClosureRecord], files: WindowFiles) -> list[ImagePair]:
    return [
        ImagePair(
            (_image(files, r.window_a, r.frame_a), _image(files, r.window_b, r.frame_b)),
            (r.frame_a, r.frame_b),
            r.is_accepted,
            _caption(r),
        )
        for r in records
    ]


def _image(files: WindowFiles, window: int, frame: int) -> Image:
    prediction, colors = files.load(window)
    return np.array(colors[int(np.searchsorted(prediction.frames, frame))])


def _caption(record: ClosureRecord) -> str:
    """Say the verdict and the numbers behind it."""
    numbers = [f"similarity {record.similarity:.2f}"]
    for value, text in (
        (record.image_inliers, "{:d} image inliers"),
        (record.inliers, "{:d} with depth"),
        (record.residual, "depth residual {:.3f}"),
        (record.scale, "scale {:.3g}"),
        (record.heading_deg, "heading {:.0f} deg"),
        (record.overlap, "overlap {:.2f}"),
    ):
        if value is not None:
            numbers.append(text.format(value))
    verdict = "closed" if record.is_accepted else f"rejected, {record.verdict}"
    return f"{verdict} ({', '.join(numbers)})"
