"""Tracks: corners followed to where they are, numbered once, through blank frames and all."""

import numpy as np
import pytest
from numpy.typing import NDArray
from rendered import RenderedDrive, seen_from

from laser_slam.backbones.classical.tracking import FrameTracks, Tracker
from laser_slam.config import ClassicalConfig

Grey = NDArray[np.uint8]


def follow(greys: list[Grey], config: ClassicalConfig | None = None) -> list[FrameTracks]:
    tracker = Tracker(config or ClassicalConfig(), memory=len(greys))
    for frame, grey in enumerate(greys):
        tracker.add(frame, grey)
    return tracker.history


def test_tracks_end_where_the_geometry_says(short_drive: RenderedDrive) -> None:
    views = follow(short_drive.greys[:3])
    _, i, j = np.intersect1d(views[0].ids, views[2].ids, return_indices=True)
    inner = np.all((views[0].pixels[i] > 12) & (views[0].pixels[i] < [627, 179]), axis=1)
    i, j = i[inner], j[inner]
    true = seen_from(short_drive, 0, 2, views[0].pixels[i])
    error = np.linalg.norm(views[2].pixels[j] - true, axis=1)
    flow = np.linalg.norm(true - views[0].pixels[i], axis=1)
    assert np.isfinite(error).sum() > 100
    assert np.nanmedian(flow) > 4
    assert np.nanmedian(error) < 0.5
    assert (error[np.isfinite(error)] < 1).mean() > 0.7


@pytest.mark.parametrize("width", [640, 320, 160])
def test_pixels_are_those_of_the_full_image(width: int) -> None:
    """The corners of a rectangle lie evenly around its centre, whatever the tracking width."""
    grey = np.zeros((192, 640), np.uint8)
    grey[20:80, 200:260] = 255
    pixels = follow([grey], ClassicalConfig(track_width=width))[0].pixels
    assert len(pixels) == 4
    np.testing.assert_allclose(pixels.mean(axis=0), [229.5, 49.5], atol=0.3)
    np.testing.assert_allclose(np.ptp(pixels, axis=0), [59, 59], atol=16)


def test_a_number_is_given_once_and_corners_are_spread(short_drive: RenderedDrive) -> None:
    views = follow(short_drive.greys[:6])
    last, seen, current = -1, set[int](), set[int]()
    for view in views:
        assert len(np.unique(view.ids)) == len(view.ids) == len(view.pixels)
        new = view.ids[view.ids > last]
        assert not set(new.tolist()) & seen
        old = view.ids[view.ids <= last].tolist()
        assert set(old) <= current
        current, last = set(view.ids.tolist()), int(view.ids.max())
        seen |= current
    halves = [(views[5].pixels[:, 0] < 320).sum(), (views[5].pixels[:, 0] >= 320).sum()]
    assert min(halves) > 0.25 * sum(halves)


def test_a_blank_frame_ends_all_tracks_and_new_ones_begin(short_drive: RenderedDrive) -> None:
    greys = short_drive.greys[:6]
    greys[3] = np.full_like(greys[3], 90)
    views = follow(greys)
    assert len(views[3].ids) == 0
    assert views[4].ids.min() > views[2].ids.max()
    assert len(np.intersect1d(views[4].ids, views[5].ids)) > 200


@pytest.mark.parametrize("size", [(376, 1240), (32, 64), (480, 640)])
def test_images_without_texture_have_no_tracks(size: tuple[int, int]) -> None:
    for view in follow([np.full(size, 128, np.uint8)] * 3):
        assert view.pixels.shape == (0, 2)


def test_the_memory_holds_the_last_frames_only(short_drive: RenderedDrive) -> None:
    tracker = Tracker(ClassicalConfig(), memory=2)
    for frame, grey in enumerate(short_drive.greys[:4]):
        tracker.add(10 * frame, grey)
    assert [view.frame for view in tracker.history] == [20, 30]
