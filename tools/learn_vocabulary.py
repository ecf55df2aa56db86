"""Learn the vocabulary that the default place descriptor ships with, from generated streets.

python tools/learn_vocabulary.py     writes laser_slam/places/vocabulary.npz, in a minute

The streets are of seeds that nothing else uses. Everything is seeded: a second run writes the
same numbers, given the same versions of OpenCV and NumPy.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track

from laser_slam.config import PlacesConfig, SyntheticConfig
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.places.vlad import VOCABULARY, corner_bits

Array32 = NDArray[np.float32]

SEEDS = (1011, 1012)
FRAMES_PER_STREET = 50
STEP_M = 4.0
ITERATIONS = 20


def main(
    out: Annotated[Path, typer.Option(help="file to write")] = VOCABULARY,
    words: Annotated[int, typer.Option(help="clusters")] = 128,
    axes: Annotated[int, typer.Option(help="numbers kept of a feature's 256 bits")] = 16,
) -> None:
    """Render the streets, find the axes of their features and the words along these."""
    features = np.concatenate(list(chain.from_iterable(map(street_features, SEEDS))))
    mean = features.mean(axis=0)
    _, directions = np.linalg.eigh(np.cov((features - mean).T))
    chosen = directions[:, ::-1][:, :axes].astype(np.float32)
    chosen *= np.sign(chosen[np.abs(chosen).argmax(axis=0), np.arange(axes)])
    centres = cluster((features - mean) @ chosen, words)
    half = {"mean": mean, "axes": chosen, "words": centres}
    np.savez(out, **{name: array.astype(np.float16) for name, array in half.items()})
    typer.echo(f"{out}: {words} words of {len(features)} features")


def street_features(seed: int) -> list[Array32]:
    """Return the (N, 256) features of each frame of a street."""
    settings = SyntheticConfig(num_frames=FRAMES_PER_STREET, step_m=STEP_M, seed=seed)
    config = PlacesConfig()
    frames = track(SyntheticDrive(settings).frames(), "rendering", total=FRAMES_PER_STREET)
    return [
        corner_bits(frame.image, config.width, config.num_features)
        for frame in frames
        if frame.image is not None
    ]


def cluster(points: Array32, num: int) -> Array32:
    """Return the (num, d) means of the clusters of (N, d) points: Lloyd's iteration."""
    chance = np.random.default_rng(0)
    centres = points[chance.choice(len(points), num, replace=False)].copy()
    for _ in range(ITERATIONS):
        nearest = np.argmax(points @ centres.T - 0.5 * (centres**2).sum(axis=1), axis=1)
        for word in range(num):
            members = points[nearest == word]
            centres[word] = members.mean(axis=0) if len(members) else chance.choice(points)
    return centres


if __name__ == "__main__":
    typer.run(main)
