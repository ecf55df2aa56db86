"""The images that go with an export, and the cameras that took them."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.camera import resize_intrinsics
from laser_slam.datasets.decoding import orientation_of, read_exif, read_image
from laser_slam.datasets.images import list_images
from laser_slam.datasets.video import VideoFile
from laser_slam.errors import DatasetError
from laser_slam.export import Camera, Photo, Photos
from laser_slam.exporting.options import PhotoKind
from laser_slam.rectification import Rectifier
from laser_slam.store.keyframes import Keyframes, Originals
from laser_slam.types import NO_DISTORTION, Image

Array = NDArray[np.float64]

JPEG_QUALITY = 95
SAME_PX = 1e-3  # cameras whose numbers differ by less are one
ADVICE = "pass --images-from DIR, or take the small ones that the run keeps: --images stored"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stored:
    """What a run keeps of a keyframe's image.

    Attributes:
        frame: index in the sequence.
        intrinsics: (3, 3) in pixels of the depth map, lens distortion taken out.
        size: (height, width) of the depth map.
        color: (H, W, 3) RGB.
    """

    frame: int
    intrinsics: Array
    size: tuple[int, int]
    color: Image


def gather_photos(
    keyframes: Keyframes,
    stored: Callable[[], Iterator[Stored]],
    originals: Originals,
    kind: PhotoKind | None,
    stride: int,
) -> Photos:
    """Say which image goes with each keyframe, and where its camera was.

    Args:
        keyframes: of the run.
        stored: reads what the run keeps of them, in order.
        originals: the run's input.
        kind: which images; None: the originals where their files are known.
        stride: of a video: every so many-th frame was read.

    Raises:
        DatasetError: originals are wanted, and their files are unknown or missing.
    """
    if kind is None and not originals.files:
        logger.warning("the run knows no image files: the small ones that it keeps are exported")
        kind = PhotoKind.STORED
    if kind is PhotoKind.STORED:
        names = [f"{frame:06d}.png" for frame in keyframes.frames]
        cameras = [Camera(one.size, one.intrinsics, NO_DISTORTION) for one in stored()]
        return _photos(keyframes, names, cameras, partial(_save_stored, stored))
    lens = _Lens(originals, undistort=kind is PhotoKind.UNDISTORTED)
    files = _Files(originals, keyframes.frames.tolist(), kind or PhotoKind.ORIGINAL, stride)
    cameras = [lens.camera(one.intrinsics, one.size) for one in stored()]
    return _photos(keyframes, files.names, cameras, partial(files.save, lens.undistort))


def move_originals(originals: Originals, folder: Path) -> Originals:
    """Look for the images in another folder, by their names, or by their order where unknown.

    Raises:
        DatasetError: no such folder, or it holds no images.
    """
    if folder.is_file():
        return Originals(originals.size, originals.calibration, (folder,))
    if originals.files:
        files = tuple(folder / path.name for path in originals.files)
    else:
        files = tuple(list_images(folder))
    return Originals(originals.size, originals.calibration, files)


def _photos(
    keyframes: Keyframes,
    names: Sequence[str],
    cameras: Sequence[Camera],
    save: Callable[[Path], None],
) -> Photos:
    """Join equal cameras."""
    rows: dict[tuple[int, ...], int] = {}
    kept: list[Camera] = []
    photos = []
    places = zip(keyframes.frames.tolist(), names, cameras, keyframes.world_from_cam, strict=True)
    for frame, name, camera, world_from_cam in places:
        key = (*camera.size, *np.rint(np.array(camera.numbers) / SAME_PX).astype(int).tolist())
        if key not in rows:
            rows[key] = len(kept)
            kept.append(camera)
        photos.append(Photo(name, frame, rows[key], world_from_cam))
    return Photos(kept, photos, save)


class _Lens:
    """From cameras of rectified depth maps to those of the original images."""

    def __init__(self, originals: Originals, *, undistort: bool) -> None:
        calibration = originals.calibration
        self._size = originals.size
        self._rectified: Array | None = None  # as the run had it, at the size of the originals
        self._intrinsics: Array | None = None
        self._distortion = NO_DISTORTION
        self.undistort: Callable[[Image], Image] | None = None
        if calibration.intrinsics is None:
            return
        rectifier = Rectifier(calibration, calibration.size)
        if rectifier.intrinsics is None or not rectifier.bends:
            return
        self._rectified = resize_intrinsics(rectifier.intrinsics, calibration.size, self._size)
        if undistort:
            full = Rectifier(calibration, self._size)
            self._intrinsics, self.undistort = full.intrinsics, full.image
        else:
            lens = calibration.intrinsics
            self._intrinsics = resize_intrinsics(lens, calibration.size, self._size)
            self._distortion = calibration.distortion

    def camera(self, intrinsics: Array, size: tuple[int, int]) -> Camera:
        """Return the camera of an original whose depth map has these intrinsics and this size."""
        seen = resize_intrinsics(intrinsics, size, self._size)
        if self._rectified is None or self._intrinsics is None:
            return Camera(self._size, seen, NO_DISTORTION)
        # What the backbone saw differently from the calibration stays different.
        out = seen.copy()
        for axis in (0, 1):
            ratio = self._intrinsics[axis, axis] / self._rectified[axis, axis]
            out[axis, axis] = seen[axis, axis] * ratio
            shift = seen[axis, 2] - self._rectified[axis, 2]
            out[axis, 2] = self._intrinsics[axis, 2] + shift * ratio
        return Camera(self._size, out, self._distortion)


class _Files:
    """The files of the originals, checked before anything is written."""

    def __init__(
        self, originals: Originals, frames: Sequence[int], kind: PhotoKind, stride: int
    ) -> None:
        self._frames, self._kind, self._stride = frames, kind, stride
        self._video: Path | None = None
        self._paths: list[Path] = []
        self._orientation = 1
        files = originals.files
        if len(files) == 1:
            self._video = files[0]
            self._refuse_missing(files)
        else:
            if not files:
                raise DatasetError(f"the run does not know the files of its images; {ADVICE}")
            if len(files) <= max(frames, default=0):
                raise DatasetError(
                    f"the run is of {max(frames) + 1} images or more, and {len(files)} are known; "
                    f"{ADVICE}"
                )
            self._paths = [files[frame] for frame in frames]
            self._refuse_missing(self._paths)
            self._orientation = orientation_of(read_exif(files[0]))
        is_copied = kind is not PhotoKind.UNDISTORTED and self._orientation == 1
        self._are_files = is_copied and self._video is None
        self.names = [f"{frame:06d}.jpg" for frame in frames]
        if self._are_files:
            self.names = [path.name for path in self._paths]

    def save(self, undistort: Callable[[Image], Image] | None, folder: Path) -> None:
        """Put the images into a folder."""
        if self._are_files:
            for path in self._paths:
                if self._kind is PhotoKind.LINKED:
                    (folder / path.name).symlink_to(path.absolute())
                else:
                    shutil.copyfile(path, folder / path.name)
            return
        for name, image in zip(self.names, self._images(), strict=True):
            _save_image(folder / name, image if undistort is None else undistort(image))

    def _images(self) -> Iterator[Image]:
        if self._video is None:
            for path in self._paths:
                image = read_image(path, self._orientation)
                if image is None:
                    raise DatasetError(f"{path} cannot be read any more; {ADVICE}")
                yield image
            return
        wanted = set(self._frames)
        num = 0
        with closing(VideoFile(self._video, stride=self._stride).frames()) as frames:
            for frame in frames:
                if frame.index in wanted and frame.image is not None:
                    num += 1
                    yield frame.image
        if num < len(wanted):
            raise DatasetError(
                f"{self._video} has only {num} of the {len(wanted)} keyframes; {ADVICE}"
            )

    def _refuse_missing(self, paths: Sequence[Path]) -> None:
        missing = [path for path in paths if not path.is_file()]
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise DatasetError(f"no original image {missing[0]}{more}; {ADVICE}")


def _save_stored(stored: Callable[[], Iterator[Stored]], folder: Path) -> None:
    for one in stored():
        _save_image(folder / f"{one.frame:06d}.png", one.color)


def _save_image(path: Path, image: Image) -> None:
    """Write an image; OpenCV alone does not say why it could not."""
    bgr = np.ascontiguousarray(image[..., ::-1])
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    path.write_bytes(cv2.imencode(path.suffix, bgr, options)[1].tobytes())
