"""Image files to RGB arrays: ahead of their use, and without being stopped by a broken one."""

from __future__ import annotations

import struct
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from laser_slam.errors import DatasetError
from laser_slam.types import Frame, Image

T = TypeVar("T")
Stream: TypeAlias = Generator[T, None, None]

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
AHEAD = 3  # frames that wait decoded; enough to hide decoding behind the computation
THREADS = 2
MAX_UNREADABLE = 0.5  # share of the frames, beyond which a sequence is no input at all
FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION  # 8 bits, grey or colour, no alpha
EXIF_IFD = 0x8769
ORIENTATION_TAG = 0x0112
NO_IMAGE = (OSError, SyntaxError, ValueError, PillowImage.DecompressionBombError)  # of Pillow


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says before it is decoded.

    Attributes:
        name: of the file.
        size: (height, width) as stored, whatever the EXIF orientation.
        mode: the kind of pixels, in Pillow's words.
    """

    name: str
    size: tuple[int, int]
    mode: str

    @property
    def pixels(self) -> str:
        """Write the size as people do, width first."""
        return f"{self.size[1]}x{self.size[0]}"

    @property
    def is_deep_grey(self) -> bool:
        """Tell whether this is 16-bit (or deeper) grey, the usual form of a depth map."""
        return self.mode.startswith(("I", "F"))


def read_image(path: Path, orientation: int = 1) -> Image | None:
    """Read an image file as (H, W, 3) RGB, turned as the EXIF ``orientation`` (1 to 8) says.

    Grey, 16-bit and transparent images are converted. None: missing, truncated or no image.
    """
    try:
        data = path.read_bytes()
    except OSError:
        return None
    image = decode_image(data)
    return None if image is None else orient(image, orientation)


def decode_image(data: bytes) -> Image | None:
    """Decode an encoded image to (H, W, 3) RGB as stored; None: truncated or no image."""
    if not data or is_truncated(data):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), FLAGS)
    except cv2.error:
        return None
    if image is None or image.dtype != np.uint8:
        return None
    is_grey = image.ndim == 2
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if is_grey else cv2.COLOR_BGR2RGB))


def is_truncated(data: bytes) -> bool:
    """Tell whether a PNG or JPEG stops before its end mark, which decoders may fill in silently."""
    if data.startswith(b"\x89PNG"):
        return data.rfind(b"IEND") < 0
    if data.startswith(b"\xff\xd8"):
        scan = _start_of_scan(data)
        return scan is None or data.find(b"\xff\xd9", scan) < 0
    return False


def _start_of_scan(data: bytes) -> int | None:
    """Skip a JPEG's header segments, whose thumbnail has an end mark of its own."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        if marker == 0xDA:
            return position
        position += 2 + int(struct.unpack(">H", data[position + 2 : position + 4])[0])
    return None


def orient(image: Image, orientation: int) -> Image:
    """Turn a stored image upright as its EXIF orientation (1 to 8) says."""
    turned = image
    if orientation in (5, 6, 7, 8):  # rows and columns are swapped
        turned = turned.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        turned = turned[:, ::-1]
    if orientation in (3, 4, 7, 8):
        turned = turned[::-1]
    return np.ascontiguousarray(turned)


def read_header(path: Path) -> ImageHeader | None:
    """Read size and kind without decoding; None: no image that Pillow knows."""
    try:
        with _opened(path) as image:
            return ImageHeader(path.name, (image.height, image.width), image.mode)
    except NO_IMAGE:
        return None


def read_exif(path: Path) -> dict[int, object]:
    """Read the EXIF entries of an image by their tags; empty where there are none.

    A PNG is decoded for it: nothing to be done for every image.
    """
    try:
        with _opened(path) as image:
            exif = image.getexif()
            return {**exif, **exif.get_ifd(EXIF_IFD)}
    except NO_IMAGE:
        return {}


@contextmanager
def _opened(path: Path) -> Iterator[PillowImage.Image]:
    """Open without decoding, and keep Pillow's warnings about odd files from the terminal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PillowImage.open(path) as image:
            yield image


def orientation_of(exif: Mapping[int, object]) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) where it is missing or wrong."""
    value = exif.get(ORIENTATION_TAG)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def check_same_kind(paths: Iterable[Path], advice: str) -> ImageHeader:
    """Refuse a sequence of images of several sizes; looks at the headers only.

    Args:
        paths: the image files; one whose header cannot be read counts as unreadable later on,
            but for the first.
        advice: what to do about images of another kind among them.

    Returns:
        The header of the first image.

    Raises:
        DatasetError: names two files and their sizes, or a 16-bit grey image (a depth map?)
            among images of another kind.
    """
    first: ImageHeader | None = None
    for path in paths:
        header = read_header(path)
        if first is None and header is None:
            raise DatasetError(first_is_unreadable(path))
        first = first or header
        if first is None or header is None:
            continue
        if header.size != first.size:
            raise DatasetError(
                f"images of different sizes in {path.parent}: {first.name} is {first.pixels}, "
                f"{header.name} is {header.pixels}; {advice}"
            )
        if header.is_deep_grey != first.is_deep_grey:
            raise DatasetError(
                f"images of different kinds in {path.parent}: of {first.name} and {header.name} "
                f"one is 16-bit grey, as depth maps are; {advice}"
            )
    if first is None:
        raise ValueError("a sequence has at least one image")
    return first


def first_is_unreadable(where: Path) -> str:
    """Say that a sequence has no beginning."""
    return (
        f"the first image of {where} cannot be read (truncated, or no image); replace or remove it"
    )


def read_ahead(jobs: Iterable[Callable[[], T]], threads: int = THREADS) -> Stream[T]:
    """Run the jobs on threads, ``AHEAD`` before their results are asked for, in order.

    An exception of a job reaches the caller in its turn. Closing the iterator stops the threads.
    """
    pool = ThreadPoolExecutor(threads, thread_name_prefix="read-ahead")
    waiting: deque[Future[T]] = deque()
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def give_up_if_unreadable(frames: Stream[Frame], where: Path, num: int | None) -> Stream[Frame]:
    """Pass the frames on, but end a sequence that is mostly broken.

    Args:
        frames: of one sequence, from the first; closed with this one.
        where: the file or folder, for the message.
        num: frames in all; None: unknown, the share is judged at the end.

    Raises:
        DatasetError: the first image, or more than half of all, cannot be read.
    """
    unreadable = total = 0
    with closing(frames):
        for frame in frames:
            total += 1
            unreadable += frame.image is None
            if unreadable == total == 1:
                raise DatasetError(first_is_unreadable(where))
            if num is not None and unreadable > MAX_UNREADABLE * num:
                raise _mostly_unreadable(where, unreadable, total)
            yield frame
    if unreadable > MAX_UNREADABLE * total:
        raise _mostly_unreadable(where, unreadable, total)


def _mostly_unreadable(where: Path, unreadable: int, total: int) -> DatasetError:
    return DatasetError(
        f"{unreadable} of the first {total} images of {where} cannot be read; "
        "copy or download them again"
    )


def read_depth(
    path: Path,
    size: tuple[int, int],
    units_per_m: float,
    advice: str,
    invalid: Sequence[int] = (0,),
) -> NDArray[np.float32]:
    """Read a depth map kept as 16-bit grey PNG.

    Args:
        path: of the file.
        size: (height, width) that it must have.
        units_per_m: of the stored numbers.
        advice: what to do about a broken file.
        invalid: numbers that stand for unknown depth.

    Returns:
        (H, W) in metres, NaN: unknown.

    Raises:
        DatasetError: the file is broken, not 16-bit grey, or of another size.
    """
    stored = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), -1)
    if stored is None or stored.dtype != np.uint16 or stored.shape != size:
        height, width = size
        raise DatasetError(f"{path} is no 16-bit grey PNG of {width}x{height} pixels; {advice}")
    metres: NDArray[np.float32] = stored.astype(np.float32) / np.float32(units_per_m)
    metres[np.isin(stored, invalid)] = np.nan
    return metres
