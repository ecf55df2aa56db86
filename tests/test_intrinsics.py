"""Intrinsics of own material: given, by field of view, from EXIF, or honestly unknown."""

import math
from pathlib import Path

import numpy as np
import pytest
from image_files import HEIGHT, WIDTH, textured, write_folder
from PIL import Image as PillowImage

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.images import ImageFolder
from laser_slam.errors import DatasetError


def test_given_intrinsics_come_before_exif(tmp_path: Path) -> None:
    write_exif_folder(tmp_path, {0xA405: 26})
    given = intrinsics_matrix(70, 71, 30, 20)
    info = ImageFolder(tmp_path, intrinsics=given).info
    np.testing.assert_array_equal(info.intrinsics, given)
    info = ImageFolder(tmp_path, fov_deg=90).info
    assert info.intrinsics is not None
    assert info.intrinsics[0, 0] == pytest.approx(WIDTH / 2)
    assert "90 degrees" in info.intrinsics_source


def write_exif_folder(folder: Path, entries: dict[int, object]) -> None:
    exif = PillowImage.Exif()
    exif.get_ifd(0x8769).update(entries)
    for index in range(3):
        PillowImage.fromarray(textured(index)).save(folder / f"{index}.jpg", exif=exif)


def test_the_35_mm_equivalent_gives_the_focal_length_by_the_diagonal(tmp_path: Path) -> None:
    write_exif_folder(tmp_path, {0xA405: 26})
    info = ImageFolder(tmp_path).info
    assert info.intrinsics is not None
    expected = 26 * math.hypot(WIDTH, HEIGHT) / math.hypot(36, 24)
    assert info.intrinsics[0, 0] == pytest.approx(expected)
    assert info.intrinsics[0, 2] == (WIDTH - 1) / 2
    assert "35 mm equivalent" in info.intrinsics_source


def test_the_sensor_resolution_gives_the_focal_length_of_a_shrunk_image(tmp_path: Path) -> None:
    # 4 mm lens, 500 px/mm on the sensor: 2000 px at 1920 wide, so 2000 / 30 at 64 wide
    write_exif_folder(
        tmp_path, {0x920A: 4.0, 0xA20E: 5000.0, 0xA210: 3, 0xA002: 1920, 0xA003: 1080}
    )
    info = ImageFolder(tmp_path).info
    assert info.intrinsics is not None
    assert info.intrinsics[0, 0] == pytest.approx(2000 / 30)


@pytest.mark.parametrize("entries", [{}, {0xA405: 0}, {0xA405: 60000}, {0x920A: 4.0}])
def test_unknown_or_absurd_exif_gives_no_intrinsics_and_says_so(
    tmp_path: Path, entries: dict[int, object]
) -> None:
    write_exif_folder(tmp_path, entries)
    info = ImageFolder(tmp_path).info
    assert info.intrinsics is None
    assert info.intrinsics_source.startswith("unknown: neither --intrinsics nor --fov given")


def test_impossible_intrinsics_are_refused(tmp_path: Path) -> None:
    write_folder(tmp_path, 3)
    with pytest.raises(DatasetError, match="fx=-70, fy=70"):
        ImageFolder(tmp_path, intrinsics=intrinsics_matrix(-70, 70, 30, 20))
    with pytest.raises(DatasetError, match=r"cx=300, cy=20 is outside the images of 64x36"):
        ImageFolder(tmp_path, intrinsics=intrinsics_matrix(70, 70, 300, 20))
    with pytest.raises(DatasetError, match="finite"):
        ImageFolder(tmp_path, intrinsics=intrinsics_matrix(70, math.nan, 30, 20))
    with pytest.raises(DatasetError, match="--fov must be between 1 and 175 degrees, got 180"):
        ImageFolder(tmp_path, fov_deg=180)
    with pytest.raises(DatasetError, match="contradict"):
        ImageFolder(tmp_path, intrinsics=intrinsics_matrix(70, 70, 30, 20), fov_deg=60)
