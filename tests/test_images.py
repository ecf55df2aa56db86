"""Folders of images: natural order, one kind, upright, and never stopped by a broken file."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from image_files import HEIGHT, WIDTH, cut_file, textured, write_folder, write_png
from PIL import Image as PillowImage
from PIL import ImageOps

from laser_slam.datasets.decoding import is_truncated, read_image
from laser_slam.datasets.images import ImageFolder
from laser_slam.errors import DatasetError


def test_images_are_sorted_by_the_numbers_in_their_names(tmp_path: Path) -> None:
    for seed, name in enumerate(["frame1.png", "frame2.PNG", "Frame10.png"]):
        write_png(tmp_path / name, textured(seed))
    (tmp_path / "notes.txt").write_text("not an image")
    frames = list(ImageFolder(tmp_path, fps=5).frames())
    for seed, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, textured(seed))
    assert [frame.time_s for frame in frames] == [0.0, 0.2, 0.4]


@pytest.mark.parametrize("suffix", [".bmp", ".JPG", ".jpeg", ".png", ".tif", ".TIFF", ".webp"])
def test_every_usual_format_is_read(tmp_path: Path, suffix: str) -> None:
    write_folder(tmp_path, 3, suffix)
    dataset = ImageFolder(tmp_path)
    assert dataset.info.size == (HEIGHT, WIDTH)
    for frame in dataset.frames():
        assert frame.image is not None
        assert frame.image.shape == (HEIGHT, WIDTH, 3)


def test_grey_16_bit_and_transparent_images_become_rgb(tmp_path: Path) -> None:
    colour = textured(0)
    grey = colour[..., 0]
    alpha = np.dstack([colour[..., ::-1], grey])
    assert cv2.imwrite(str(tmp_path / "grey.png"), grey)
    assert cv2.imwrite(str(tmp_path / "deep.png"), grey.astype(np.uint16) * 257)
    assert cv2.imwrite(str(tmp_path / "alpha.png"), alpha)
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), np.dstack([grey] * 3))
    deep = read_image(tmp_path / "deep.png")
    assert deep is not None
    assert np.abs(deep[..., 1].astype(int) - grey).max() <= 1
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), colour)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_stand_upright_as_their_exif_orientation_says(
    tmp_path: Path, orientation: int
) -> None:
    exif = PillowImage.Exif()
    exif[0x0112] = orientation
    for index in range(3):
        stored = PillowImage.fromarray(textured(index))
        stored.save(tmp_path / f"{index}.png", exif=exif)
    dataset = ImageFolder(tmp_path)
    frame = next(dataset.frames())
    with PillowImage.open(tmp_path / "0.png") as stored:
        upright = np.asarray(ImageOps.exif_transpose(stored))
    np.testing.assert_array_equal(frame.image, upright)
    assert dataset.info.size == upright.shape[:2]


def test_a_camera_that_is_tipped_in_between_stays_one_camera(tmp_path: Path) -> None:
    for index, orientation in enumerate([1, 6, 1]):
        exif = PillowImage.Exif()
        exif[0x0112] = orientation
        PillowImage.fromarray(textured(index)).save(tmp_path / f"{index}.jpg", exif=exif)
    images = [frame.image for frame in ImageFolder(tmp_path).frames()]
    assert {image.shape for image in images if image is not None} == {(HEIGHT, WIDTH, 3)}


def test_a_pattern_picks_the_images_of_one_kind(tmp_path: Path) -> None:
    folder = tmp_path / "kitchen"
    for index in range(3):
        write_png(folder / f"{index}.color.png", textured(index))
        write_png(folder / f"{index}.depth.png", np.full((HEIGHT, WIDTH), index, np.uint16))
    with pytest.raises(DatasetError, match=r"different kinds in .*0.depth.png .*\*.color.jpg"):
        ImageFolder(folder)
    info = ImageFolder(folder / "*.color.png").info
    assert (info.num_frames, info.name) == (3, "kitchen")


def test_images_of_several_sizes_are_refused_by_name(tmp_path: Path) -> None:
    write_folder(tmp_path, 3)
    write_png(tmp_path / "000007.png", textured(0, 20, 30))
    with pytest.raises(DatasetError, match=r"000000.png is 64x36, 000007.png is 30x20; keep"):
        ImageFolder(tmp_path)


def test_folders_without_a_sequence_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no folder .*nowhere; give a folder"):
        ImageFolder(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"no images in .* need at least 3"):
        ImageFolder(tmp_path)
    write_folder(tmp_path, 1)
    with pytest.raises(DatasetError, match=r"1 image in .* need at least 3"):
        ImageFolder(tmp_path)
    write_folder(tmp_path, 2)
    with pytest.raises(DatasetError, match=r"2 images in .* need at least 3"):
        ImageFolder(tmp_path)
    with pytest.raises(DatasetError, match="is a file, not a folder of images"):
        ImageFolder(tmp_path / "000000.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".bmp", ".tif"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_a_truncated_image_in_the_middle_comes_as_none(
    tmp_path: Path, suffix: str, share: float
) -> None:
    write_folder(tmp_path, 5, suffix)
    cut_file(tmp_path / f"000002{suffix}", share)
    images = [frame.image for frame in ImageFolder(tmp_path).frames()]
    assert [image is None for image in images] == [False, False, True, False, False]


def test_a_thumbnail_does_not_hide_that_a_jpeg_is_truncated(tmp_path: Path) -> None:
    write_folder(tmp_path, 1, ".jpg")
    path = tmp_path / "000000.jpg"
    data = path.read_bytes()
    note = b"thumbnail\xff\xd9"
    segment = b"\xff\xe1" + (len(note) + 2).to_bytes(2, "big") + note
    path.write_bytes(data[:2] + segment + data[2:])
    assert read_image(path) is not None
    assert not is_truncated(path.read_bytes())
    cut_file(path, 0.9)
    assert is_truncated(path.read_bytes())
    assert read_image(path) is None


def test_a_first_image_that_cannot_be_read_ends_the_run(tmp_path: Path) -> None:
    write_folder(tmp_path, 5)
    cut_file(tmp_path / "000000.png")
    with pytest.raises(DatasetError, match=r"the first image of .* cannot be read"):
        list(ImageFolder(tmp_path).frames())
    (tmp_path / "000000.png").write_text("no image at all")
    with pytest.raises(DatasetError, match=r"the first image of .* cannot be read"):
        ImageFolder(tmp_path)


def test_more_than_half_unreadable_images_end_the_run(tmp_path: Path) -> None:
    write_folder(tmp_path, 8)
    for index in (2, 3, 5, 6):
        (tmp_path / f"{index:06d}.png").write_text("not an image")
    assert sum(frame.image is None for frame in ImageFolder(tmp_path).frames()) == 4
    cut_file(tmp_path / "000007.png")
    with pytest.raises(DatasetError, match=r"5 of the first 8 images of .* cannot be read"):
        list(ImageFolder(tmp_path).frames())
