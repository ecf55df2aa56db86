"""Place recognition: descriptors, the index, and which pairs are proposed."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from rendered import RenderedDrive
from views import street_views

from laser_slam.config import PlacesConfig
from laser_slam.errors import ConfigError
from laser_slam.places import (
    Candidate,
    CandidateSearch,
    Place,
    PlaceIndex,
    make_descriptor,
)
from laser_slam.types import Image

Array32 = NDArray[np.float32]
SIZE = 256
NOISE = 0.4  # of a second look at a place, against its descriptor of length 1


def unit(vectors: NDArray[np.float64]) -> Array32:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32)


def looks(places: Sequence[int], seed: int = 0) -> Array32:
    """Return a descriptor for each visit of a numbered place; all share a common part."""
    worlds = np.random.default_rng(7).normal(size=(max(places) + 1, SIZE))
    noise = np.random.default_rng(seed).normal(size=(len(places), SIZE))
    return unit(0.7 + worlds[list(places)] + NOISE * noise)


def drive(
    places: Sequence[int], config: PlacesConfig, travelled: Sequence[float] | None = None
) -> list[Candidate]:
    """Visit places in turn, one median depth apart unless told, ten keyframes to a window."""
    search = CandidateSearch(config, SIZE)
    way = range(len(places)) if travelled is None else travelled
    visits = [Place(i, i // 10, float(w)) for i, w in enumerate(way)]
    descriptors = looks(places)
    windows = [slice(i, i + 10) for i in range(0, len(places), 10)]
    return [hit for window in windows for hit in search.add(visits[window], descriptors[window])]


def pairs(hits: Sequence[Candidate]) -> set[tuple[int, int]]:
    return {(hit.older.frame, hit.newer.frame) for hit in hits}


@pytest.fixture(scope="module")
def places() -> list[Image]:
    """Sixteen views of a street, four metres apart."""
    return street_views()


@pytest.fixture(scope="module")
def described(places: list[Image]) -> Array32:
    return np.stack([make_descriptor(PlacesConfig()).describe(image) for image in places])


def test_a_descriptor_is_of_unit_length_and_always_the_same(
    places: list[Image], described: Array32
) -> None:
    descriptor = make_descriptor(PlacesConfig())
    assert described.dtype == np.float32
    assert described.shape == (16, descriptor.size)
    np.testing.assert_allclose(np.linalg.norm(described, axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(descriptor.describe(places[3]), described[3])


def test_places_are_told_apart_a_metre_on_and_in_other_light(
    short_drive: RenderedDrive, described: Array32
) -> None:
    descriptor = make_descriptor(PlacesConfig())
    index = PlaceIndex(descriptor.size)
    index.insert(described)
    seen = np.stack([descriptor.describe(image) for image in short_drive.images[:12:4]])
    index.insert(seen)
    for row, frame in enumerate(range(0, 12, 4)):
        a_metre_on = short_drive.images[frame + 1]
        darker = np.asarray(0.7 * a_metre_on + 5, np.uint8)
        for image in (a_metre_on, darker):
            best, similarity = index.query(descriptor.describe(image), 2)
            assert best[0] == len(described) + row
            assert similarity[0] > 0.15
            others = index.similarities(descriptor.describe(image)[None])[0, : len(described)]
            assert others.max() < 0.6 * similarity[0]


@pytest.mark.parametrize("shade", [0, 130, 255])
def test_an_image_of_one_colour_resembles_nothing(shade: int, described: Array32) -> None:
    descriptor = make_descriptor(PlacesConfig())
    blank = descriptor.describe(np.full((192, 640, 3), shade, np.uint8))
    assert not blank.any()
    index = PlaceIndex(descriptor.size)
    index.insert(np.vstack([blank, described, blank]))
    found = index.similarities(np.vstack([blank, described[:1]]))
    assert not found[0].any()
    assert found[1, 0] == found[1, -1] == 0
    assert np.isfinite(found).all()


def test_an_unknown_descriptor_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(ConfigError, match=r"places\.descriptor: no 'sald'; there is vlad"):
        make_descriptor(PlacesConfig(descriptor="sald"))


@pytest.mark.parametrize("num", [3, 700, 5000])
def test_the_index_equals_brute_force(num: int) -> None:
    chance = np.random.default_rng(num)
    rows = unit(0.5 + chance.normal(size=(num, 64)))
    probes = unit(0.5 + chance.normal(size=(4, 64)))
    index = PlaceIndex(64)
    for part in np.array_split(rows, 3):
        index.insert(part)
    mean = rows.sum(axis=0) / (num + 32)
    centred = unit((rows - mean).astype(np.float64))
    expected = unit((probes - mean).astype(np.float64)) @ centred.T
    np.testing.assert_allclose(index.similarities(probes), expected, atol=2e-3)
    best, similarity = index.query(probes[0], 5, stop=num - 1)
    nearest = np.sort(expected[0, : num - 1])[::-1][:5]
    np.testing.assert_allclose(similarity, nearest, atol=2e-3)
    np.testing.assert_allclose(expected[0, best], similarity, atol=2e-3)
    assert (best < num - 1).all()


def test_an_empty_index_finds_nothing() -> None:
    best, similarity = PlaceIndex(8).query(np.eye(8, dtype=np.float32)[0], 3)
    assert len(best) == len(similarity) == 0


def test_the_mean_of_the_run_is_no_similarity() -> None:
    rows = looks(range(200))
    index = PlaceIndex(SIZE)
    index.insert(rows)
    raw = rows @ rows.T - np.eye(200)
    centred = index.similarities(rows) - np.eye(200)
    assert np.median(raw) > 0.2
    assert abs(np.median(centred)) < 0.05


def test_a_revisit_is_proposed_and_nothing_else() -> None:
    hits = drive([*range(100), *range(20, 30)], PlacesConfig())
    assert hits
    assert all(newer - older == 80 for older, newer in pairs(hits))


def test_a_drive_without_revisit_proposes_nothing() -> None:
    assert not drive(range(150), PlacesConfig())


def test_queries_come_before_inserts() -> None:
    """Of two windows that see the same, only the second can find the first."""
    hits = drive([*range(10), *range(10)], PlacesConfig())
    assert {hit.older.window for hit in hits} == {0}
    assert {hit.newer.window for hit in hits} == {1}


def test_a_place_seen_three_times_keeps_all_its_loops() -> None:
    visit, elsewhere = list(range(10)), iter(range(10, 200))
    way = [*visit, *(next(elsewhere) for _ in range(40)), *visit]
    way += [*(next(elsewhere) for _ in range(40)), *visit]
    hits = drive(way, PlacesConfig())
    windows = {(hit.older.window, hit.newer.window) for hit in hits}
    assert windows == {(0, 5), (0, 10), (5, 10)}


def test_of_neighbouring_pairs_the_most_similar_one_is_proposed() -> None:
    config = PlacesConfig(suppression=20, max_per_window_pair=50, max_per_window=50)
    everything = PlacesConfig(suppression=0, max_per_window_pair=50, max_per_window=50)
    way = [*range(100), *range(20, 30)]
    chosen, hits = drive(way, config), drive(way, everything)
    assert len(hits) > len(chosen) == 1
    assert chosen[0].similarity == max(hit.similarity for hit in hits)


def test_a_pair_stands_for_less_similar_ones_of_the_windows_that_follow() -> None:
    config = PlacesConfig(suppression=30, max_per_window_pair=50, max_per_window=50)
    everything = PlacesConfig(suppression=0, max_per_window_pair=50, max_per_window=50)
    way = [*range(100), *range(20, 60)]
    hits = drive(way, config)
    similarities = [hit.similarity for hit in sorted(hits, key=lambda hit: hit.newer.frame)]
    assert len({hit.newer.window for hit in drive(way, everything)}) == 4
    assert len(hits) < 4
    assert similarities == sorted(similarities)
    assert similarities[-1] == max(hit.similarity for hit in drive(way, everything))


def test_two_windows_get_no_more_than_their_few_candidates() -> None:
    config = PlacesConfig(suppression=0, max_per_window_pair=3)
    hits = drive([*range(100), *range(20, 30)], config)
    assert len(hits) == 3
    assert len(drive([*range(100), *range(20, 30)], PlacesConfig(max_per_window=1))) == 1


def test_standing_still_makes_no_loop() -> None:
    """Twenty keyframes of one view: however long it takes, no way was travelled."""
    places = [*range(100), *[100] * 20]
    way = [*range(100), *[100] * 20]
    assert not drive(places, PlacesConfig(), way)
    assert drive(places, PlacesConfig())  # the same views, were they on the way


def test_the_gap_is_a_way_and_not_a_number_of_frames() -> None:
    way = [*range(30), *range(10)]
    assert drive(way, PlacesConfig(min_gap=25))
    assert not drive(way, PlacesConfig(min_gap=35))
    assert drive(way, PlacesConfig(min_gap=35), [2.0 * i for i in range(40)])


def test_the_threshold_follows_the_run() -> None:
    """Where all places look alike, what a loop needs is more."""
    search = CandidateSearch(PlacesConfig(), SIZE)
    places = [Place(i, i // 10, float(i)) for i in range(300)]
    chance = np.random.default_rng(0)
    few_looks = chance.normal(size=(8, SIZE))  # any place is a blend of these
    alike = unit(chance.normal(size=(300, 8)) @ few_looks)
    similar = np.abs(alike @ alike.T - np.eye(300)).max()
    assert similar > 0.9
    assert not search.add(places[:200], alike[:200])
    assert not search.add(places[200:], alike[200:])


def test_a_blank_keyframe_is_no_place() -> None:
    search = CandidateSearch(PlacesConfig(), SIZE)
    descriptors = looks(range(60))
    descriptors[::2] = 0
    for start in (0, 20, 40):
        rows = range(start, start + 20)
        visits = [Place(i, start // 20, float(i)) for i in rows]
        assert not search.add(visits, descriptors[start : start + 20])


def test_a_way_that_falls_is_refused() -> None:
    search = CandidateSearch(PlacesConfig(), SIZE)
    search.add([Place(0, 0, 5.0)], looks([0]))
    with pytest.raises(ValueError, match="cannot fall"):
        search.add([Place(1, 0, 4.0)], looks([1]))
    with pytest.raises(ValueError, match="must be finite"):
        search.add([Place(1, 0, float("nan"))], looks([1]))
