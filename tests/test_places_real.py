"""Place recognition on real pixels: a loop that is one, and a road without any."""

import os
from pathlib import Path

import pytest

from laser_slam.config import PlacesConfig
from laser_slam.datasets.base import Dataset
from laser_slam.datasets.images import ImageFolder
from laser_slam.datasets.kitti import KittiOdometry
from laser_slam.places import (
    Candidate,
    CandidateSearch,
    Place,
    find_features,
    make_descriptor,
    verify,
)

DATA = os.environ.get("LASER_SLAM_DATA")
STRIDE = 2
WINDOW = 15

pytestmark = pytest.mark.skipif(DATA is None, reason="needs LASER_SLAM_DATA: real sequences")


def recognise(
    dataset: Dataset, way: float, config: PlacesConfig
) -> tuple[list[Candidate], list[Candidate]]:
    """Return proposed and verified pairs of every other frame, each so many median depths on."""
    images = {frame.index: frame.image for frame in dataset.frames() if frame.index % STRIDE == 0}
    descriptor = make_descriptor(config)
    search = CandidateSearch(config, descriptor.size)
    hits: list[Candidate] = []
    for count, (frame, image) in enumerate(images.items()):
        assert image is not None
        place = Place(frame, count // WINDOW, way * count)
        hits += search.add([place], descriptor.describe(image)[None])
    pairs = {hit: (images[hit.older.frame], images[hit.newer.frame]) for hit in hits}
    kept = []
    for hit, (older, newer) in pairs.items():
        assert older is not None
        assert newer is not None
        first, second = (find_features(image, config.verification) for image in (older, newer))
        verdict = verify(first, second, dataset.info.intrinsics, config.verification)
        if verdict.rejected is None:
            kept.append(hit)
    return hits, kept


def test_a_walk_round_an_office_comes_back_to_its_start() -> None:
    _, closed = recognise(ImageFolder(Path(DATA or "") / "office_loop"), 0.3, PlacesConfig())
    assert closed
    for hit in closed:
        assert hit.older.frame <= 20
        assert hit.newer.frame >= 224


def test_a_road_without_a_revisit_proposes_nothing() -> None:
    road = KittiOdometry(Path(DATA or "") / "kitti_odometry", "03")
    proposed, _ = recognise(road, 0.1, PlacesConfig())
    assert not proposed


def test_geometry_refuses_all_that_a_low_threshold_proposes() -> None:
    config = PlacesConfig(min_contrast=2.5, min_similarity=0)
    road = KittiOdometry(Path(DATA or "") / "kitti_odometry", "03")
    proposed, closed = recognise(road, 0.1, config)
    assert len(proposed) > 5
    assert not closed
