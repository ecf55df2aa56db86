"""Measure place recognition on a sequence whose true revisits are known, or that has none.

python tools/evaluate_places.py kitti ROOT --sequence 07 --stride 3      poses tell the revisits
python tools/evaluate_places.py images DIR --same 0:16,228:236 --step 0.15   no poses: all frames
                                                                       of --same see one place
python tools/evaluate_places.py kitti ROOT --sequence 03 --out DIR      no revisit; with a picture

Prints how well descriptors alone find the place (best of one, best of five, precision and recall
over the threshold), then candidates, then verified candidates, with CPU time of each step.
A pair is right within --near and --angle, and wrong beyond three times --near or the angle: what
lies between counts as neither.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum
from itertools import islice
from pathlib import Path
from typing import Annotated

import cv2
import matplotlib as mpl
import numpy as np
import typer
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from laser_slam.config import load_config
from laser_slam.config.places import PlacesConfig
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.images import ImageFolder
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.datasets.seven_scenes import SevenScenes
from laser_slam.errors import LaserSlamError
from laser_slam.places import (
    Candidate,
    CandidateSearch,
    Place,
    PlaceIndex,
    Verification,
    find_features,
    make_descriptor,
    verify,
)
from laser_slam.types import Image

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

KEYFRAMES_PER_WINDOW = 15  # windows of 20 that share 5
WRONG = 3  # times --near from which a pair is wrong


class Kind(StrEnum):
    """Layouts that can be read."""

    KITTI = "kitti"
    SEVEN_SCENES = "7scenes"
    IMAGES = "images"


@dataclass(frozen=True)
class Truth:
    """Which pairs of keyframes are which.

    Attributes:
        right: (N, N) newer row and older column see the same place, from the same direction.
        wrong: (N, N) they do not.
        travelled: (N,) way in median depths.
    """

    right: Mask
    wrong: Mask
    travelled: Array


def main(  # noqa: PLR0913, PLR0917  (each is an option of the command line)
    kind: Annotated[Kind, typer.Argument(help="layout")],
    root: Annotated[Path, typer.Argument(help="folder")],
    sequence: Annotated[str, typer.Option(help="of KITTI")] = "00",
    stride: Annotated[int, typer.Option(help="every so many-th frame is a keyframe")] = 1,
    near: Annotated[float, typer.Option(help="metres between right pairs")] = 4.0,
    angle: Annotated[float, typer.Option(help="degrees between right pairs")] = 30.0,
    median_depth: Annotated[float, typer.Option(help="metres: unit of the way")] = 12.0,
    step: Annotated[float, typer.Option(help="way of a keyframe, without poses")] = 0.15,
    same: Annotated[str, typer.Option(help="frames of one place: 0:16,228:236")] = "",
    out: Annotated[Path | None, typer.Option(help="folder of the similarity matrix")] = None,
    assignments: Annotated[list[str] | None, typer.Option("--set", help="setting")] = None,
) -> None:
    """Describe, search and verify a sequence, and print how right that is."""
    cv2.setNumThreads(1)
    try:
        config = load_config(assignments=assignments or []).places
        dataset = _read(kind, root, sequence)
        images, frames = _keyframes(dataset, stride)
    except LaserSlamError as error:
        typer.echo(f"evaluate_places: {error}", err=True)
        raise typer.Exit(1) from error
    truth = _truth_of_poses(dataset, frames, (near, angle), median_depth)
    truth = truth or _truth_of_ranges(frames, same, step)
    descriptors, similarity = describe(images, config)
    is_asked = truth.travelled[:, None] - truth.travelled >= config.min_gap
    is_right, is_wrong = truth.right & is_asked, truth.wrong & is_asked
    print_retrieval(similarity, is_asked, is_right, is_wrong)
    candidates = search(descriptors, truth.travelled, config)
    verdicts = check(images, candidates, dataset.info.intrinsics, config)
    print_candidates(candidates, verdicts, is_right, is_wrong)
    if out:
        draw(similarity, is_asked, candidates, verdicts, out / f"{dataset.info.name}_places.png")


def describe(images: list[Image], config: PlacesConfig) -> tuple[NDArray[np.float32], Array]:
    """Return (N, D) descriptors, and the (N, N) similarities as each was when it was asked for."""
    descriptor = make_descriptor(config)
    start = time.process_time()
    descriptors = np.stack([descriptor.describe(image) for image in images])
    typer.echo(f"description: {1e3 * (time.process_time() - start) / len(images):.1f} ms")
    index = PlaceIndex(descriptor.size)
    similarity = np.zeros((len(images), len(images)))
    start = time.process_time()
    for i, vector in enumerate(descriptors):
        similarity[i, :i] = index.similarities(vector[None])
        index.insert(vector[None])
    typer.echo(f"retrieval: {1e3 * (time.process_time() - start) / len(images):.2f} ms")
    return descriptors, similarity


def search(
    descriptors: NDArray[np.float32], travelled: Array, config: PlacesConfig
) -> list[Candidate]:
    """Propose pairs, window by window; a place's frame is its row here."""
    finder = CandidateSearch(config, descriptors.shape[1])
    found: list[Candidate] = []
    start = time.process_time()
    for first in range(0, len(descriptors), KEYFRAMES_PER_WINDOW):
        rows = range(first, min(first + KEYFRAMES_PER_WINDOW, len(descriptors)))
        places = [Place(i, first // KEYFRAMES_PER_WINDOW, float(travelled[i])) for i in rows]
        found += finder.add(places, descriptors[rows.start : rows.stop])
    spent = 1e3 * (time.process_time() - start) / len(descriptors)
    typer.echo(f"search, window by window: {spent:.2f} ms per keyframe")
    return found


def check(
    images: list[Image],
    candidates: list[Candidate],
    intrinsics: Array | None,
    config: PlacesConfig,
) -> list[Verification]:
    """Verify all candidates."""
    start = time.process_time()
    verdicts = []
    for candidate in candidates:
        pair = (candidate.older.frame, candidate.newer.frame)
        first, second = (find_features(images[row], config.verification) for row in pair)
        verdicts.append(verify(first, second, intrinsics, config.verification))
    spent = 1e3 * (time.process_time() - start) / max(1, len(candidates))
    typer.echo(f"verification: {spent:.0f} ms per pair, features of both images included")
    return verdicts


def print_retrieval(similarity: Array, is_asked: Mask, is_right: Mask, is_wrong: Mask) -> None:
    """Print what the descriptors alone find."""
    asked = np.flatnonzero(is_right.any(axis=1))
    masked = np.where(is_asked, similarity, -np.inf)
    order = np.argsort(-masked, axis=1)[:, :5]
    hit = np.take_along_axis(is_right, order, axis=1)
    typer.echo(f"{len(masked)} keyframes, {len(asked)} of them see a place again")
    if len(asked):
        first, five = hit[asked, 0].mean(), hit[asked].any(axis=1).mean()
        typer.echo(f"right among the first: {first:.2f}, among the first five: {five:.2f}")
    best, best_is_right = masked.max(axis=1), hit[:, 0]
    best_is_wrong = is_wrong[np.arange(len(masked)), order[:, 0]] & np.isfinite(best)
    for threshold in np.arange(0.05, 0.65, 0.05):
        right = int((best_is_right & (best >= threshold)).sum())
        wrong = int((best_is_wrong & (best >= threshold)).sum())
        recall = f"{right / len(asked):.2f}" if len(asked) else "-"
        typer.echo(
            f"  similarity >= {threshold:.2f}: {right} right, {wrong} wrong, recall {recall}"
        )


def print_candidates(
    candidates: list[Candidate], verdicts: list[Verification], is_right: Mask, is_wrong: Mask
) -> None:
    """Print precision and recall before and after verification, and each verified mistake."""
    revisited = np.unique(np.flatnonzero(is_right.any(axis=1)) // KEYFRAMES_PER_WINDOW)
    for name, is_kept in (
        ("candidates", [True] * len(verdicts)),
        ("verified", [not verdict.rejected for verdict in verdicts]),
    ):
        kept = [candidates[i] for i in np.flatnonzero(is_kept)]
        right = [c for c in kept if is_right[c.newer.frame, c.older.frame]]
        wrong = [c for c in kept if is_wrong[c.newer.frame, c.older.frame]]
        closed = {c.newer.frame // KEYFRAMES_PER_WINDOW for c in right} & set(revisited.tolist())
        typer.echo(
            f"{name}: {len(kept)}, {len(right)} right, {len(wrong)} wrong, "
            f"{len(kept) - len(right) - len(wrong)} between; "
            f"{len(closed)} of {len(revisited)} revisiting windows closed"
        )
    for candidate, verdict in sorted(
        zip(candidates, verdicts, strict=True), key=lambda pair: -pair[1].num_inliers
    ):
        pair = candidate.newer.frame, candidate.older.frame
        word = "right" if is_right[pair] else "WRONG" if is_wrong[pair] else "between"
        typer.echo(
            f"  {word} {pair[0]}-{pair[1]}: similarity {candidate.similarity:.2f}, "
            f"contrast {candidate.contrast:.1f}, {verdict.num_inliers} inliers of "
            f"{verdict.num_matches}, support {verdict.support}; "
            f"{'rejected' if verdict.rejected else 'verified'}"
        )


def draw(
    similarity: Array,
    is_asked: Mask,
    candidates: list[Candidate],
    verdicts: list[Verification],
    path: Path,
) -> None:
    """Draw the similarity matrix with the candidates."""
    mpl.use("Agg")
    figure, axes = plt.subplots(figsize=(9, 8), layout="constrained")
    shown = np.where(is_asked, similarity, np.nan)
    image = axes.imshow(shown, cmap="magma", vmin=0, vmax=0.3, interpolation="nearest")
    figure.colorbar(image, label="similarity, mean of the run removed")
    for is_kept, color, label in ((True, "lime", "verified"), (False, "cyan", "rejected")):
        pairs = [
            (candidate.older.frame, candidate.newer.frame)
            for candidate, verdict in zip(candidates, verdicts, strict=True)
            if (verdict.rejected is None) == is_kept
        ]
        x, y = np.array(pairs).reshape(-1, 2).T
        axes.scatter(x, y, s=30, facecolors="none", edgecolors=color, label=f"{label} {len(x)}")
    axes.set(xlabel="older keyframe", ylabel="newer keyframe", title=path.stem)
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _read(kind: Kind, root: Path, sequence: str) -> Dataset:
    if kind is Kind.KITTI:
        return KittiOdometry(root, sequence)
    return SevenScenes(root) if kind is Kind.SEVEN_SCENES else ImageFolder(root)


def _keyframes(dataset: Dataset, stride: int) -> tuple[list[Image], NDArray[np.int64]]:
    kept = [
        (frame.image, frame.index)
        for frame in islice(dataset.frames(), 0, None, stride)
        if frame.image is not None
    ]
    return [image for image, _ in kept], np.array([index for _, index in kept])


def _truth_of_poses(
    dataset: Dataset,
    frames: NDArray[np.int64],
    limits: tuple[float, float],
    median_depth: float,
) -> Truth | None:
    """Compare all poses; ``limits`` in metres and degrees."""
    truth = dataset.info.truth
    if truth is None or not np.isin(frames, truth.frames).all():
        return None
    poses = truth.world_from_cam[np.searchsorted(truth.frames, frames)]
    centres, rotations = poses[:, :3, 3], poses[:, :3, :3]
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    cosine = (np.einsum("iab,jab->ij", rotations, rotations) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    travelled = np.zeros(len(centres))
    travelled[1:] = np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1)) / median_depth
    right = (distance < limits[0]) & (turn < limits[1])
    wrong = (distance > WRONG * limits[0]) | (turn > WRONG * limits[1])
    return Truth(right, wrong, travelled)


def _truth_of_ranges(frames: NDArray[np.int64], same: str, step: float) -> Truth:
    """Take frames of the given ranges as one place, and any two others as two."""
    is_there = np.zeros(len(frames), np.bool_)
    for part in filter(None, same.split(",")):
        first, _, last = part.partition(":")
        is_there |= (frames >= int(first)) & (frames <= int(last))
    right = is_there[:, None] & is_there
    return Truth(right, ~right, step * np.arange(len(frames), dtype=np.float64))


if __name__ == "__main__":
    typer.run(main)
