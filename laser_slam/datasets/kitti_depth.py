"""KITTI depth (annotated): drives with LiDAR depth, accumulated and cleaned, for video depth."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.kitti import DEPTH_UNITS_PER_M
from laser_slam.datasets.kitti_calibration import read_rows
from laser_slam.datasets.lens import Lens
from laser_slam.datasets.listed import ListedSequence, Shot, numbered_files
from laser_slam.errors import DatasetError

RATE_HZ = 10.0
CAMERA = "image_02"  # left colour
ROW = "P_rect_02"  # its projection
AGAIN = "unpack data_depth_annotated and the raw drive again"
GATHERED = ("groundtruth_depth_gathered", "image_gathered")  # what published evaluations copy


class KittiDepth(ListedSequence):
    """One drive: ``val/DRIVE/proj_depth/groundtruth/image_02/*.png`` and the raw images of it.

    The frames are those that have a depth map: the release leaves out a drive's first and last
    five. Depth is 16 bits, metres times 256, 0: unknown. The raw images are looked for as
    ``DRIVE/image_02/data`` in the given folder, in the drive's own, and in ``raw`` beside ``val``,
    with or without the day's folder (``2011_09_26``), where the calibration is read from.
    A folder of ``image_gathered`` with its twin in ``groundtruth_depth_gathered`` is read too: the
    first 110 frames, which published evaluations copy.
    10 frames a second by the number in the name; there are no poses.

    Args:
        folder: of one drive, such as ``val/2011_09_26_drive_0002_sync``.
        raw: folder of the raw drives; None: looked for.

    Raises:
        DatasetError: no depth maps or no images there, images that are missing, or of several
            sizes.
    """

    again = AGAIN

    def __init__(self, folder: Path, *, raw: Path | None = None) -> None:
        folder = folder.resolve()
        depth = _list_depth(folder)
        images_folder = _find_images(folder, raw)
        images = numbered_files(images_folder, "", (".png", ".jpg"))
        missing = [number for number in depth if number not in images]
        if missing:
            raise DatasetError(
                f"{len(missing)} of {len(depth)} depth maps have no image in {images_folder}, the "
                f"first is {missing[0]:010d}; {AGAIN}"
            )
        shots = [Shot(number / RATE_HZ, images[number], path) for number, path in depth.items()]
        super().__init__(
            f"kitti-depth-{folder.name.split('_sync')[0]}",
            shots,
            _lens(images_folder),
            partial(read_depth, units_per_m=DEPTH_UNITS_PER_M, advice=AGAIN),
        )


def _list_depth(folder: Path) -> dict[int, Path]:
    """List the depth maps by their numbers, of which there must be some."""
    if folder.parent.name in GATHERED:
        found = folder.parent.with_name(GATHERED[0]) / folder.name
    else:
        found = folder / "proj_depth" / "groundtruth" / CAMERA
    depth = numbered_files(found, "", (".png",))
    if not depth:
        raise DatasetError(
            f"no depth maps in {found}; give a drive such as val/2011_09_26_drive_0002_sync"
        )
    return depth


def _find_images(folder: Path, raw: Path | None) -> Path:
    """Return the folder of the images."""
    if folder.parent.name in GATHERED:
        return folder.parent.with_name(GATHERED[1]) / folder.name
    drive, day = folder.name, folder.name[:10]
    above = [raw] if raw else [folder.parent, folder.parent.parent / "raw", folder.parent.parent]
    places = [place / part for place in above for part in (drive, f"{day}/{drive}")]
    for place in places:
        if (place / CAMERA / "data").is_dir():
            return place / CAMERA / "data"
    raise DatasetError(
        f"no images of {drive} in {' or '.join(str(place) for place in above)}; pass --raw, the "
        f"folder that holds {day}/{drive}/{CAMERA}/data"
    )


def _lens(images_folder: Path) -> Lens:
    path = images_folder.parents[2] / "calib_cam_to_cam.txt"
    if not path.is_file():
        return Lens(None, f"unknown: no {path.name} in the folder of the day")
    values = read_rows(path, AGAIN).get(ROW)
    if values is None or len(values) != 12:
        raise DatasetError(f"{path} has no row {ROW} of 12 numbers; {AGAIN}")
    return Lens(values.reshape(3, 4)[:, :3], f"{path.name}, row {ROW}")
