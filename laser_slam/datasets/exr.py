"""Depth maps in OpenEXR files, of which OpenCV's wheels are built without a reader."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DatasetError

MAGIC = b"\x76\x2f\x31\x01"
OTHER_KINDS = 0x200 | 0x800 | 0x1000  # tiles, deep pixels, several parts
LINES_OF_BLOCK = {0: 1, 2: 1, 3: 16}  # by compression: none, zip of a line, zip of 16 lines
PIXELS = {1: "<f2", 2: "<f4"}


@dataclass(frozen=True)
class _Header:
    compression: int
    pixels: np.dtype[np.floating]
    top: int
    size: tuple[int, int]
    end: int


def read_exr(path: Path, advice: str) -> NDArray[np.float32]:
    """Read an OpenEXR image of one channel of half or single floats, in scan lines.

    Compression: none, ZIP or ZIPS, which is what OpenCV writes.

    Args:
        path: of the file.
        advice: what to do about a file that cannot be read.

    Returns:
        (H, W) the numbers as stored.

    Raises:
        DatasetError: it is cut, no OpenEXR file, or of another kind.
    """
    data = path.read_bytes()
    try:
        header = _read_header(data)
        return _read_blocks(data, header)
    except (struct.error, zlib.error, ValueError, KeyError, IndexError) as error:
        raise DatasetError(
            f"{path} is no OpenEXR image of one channel in scan lines ({error}); {advice}"
        ) from error


def _read_header(data: bytes) -> _Header:
    if data[:4] != MAGIC:
        raise ValueError("it begins otherwise")
    (version,) = struct.unpack_from("<i", data, 4)
    if version & OTHER_KINDS:
        raise ValueError("it has tiles, parts or deep pixels")
    attributes, position = {}, 8
    while data[position] != 0:
        name, position = _string(data, position)
        _, position = _string(data, position)
        (length,) = struct.unpack_from("<i", data, position)
        attributes[name] = data[position + 4 : position + 4 + length]
        position += 4 + length
    compression = attributes["compression"][0]
    if compression not in LINES_OF_BLOCK:
        raise ValueError(f"its compression is number {compression}")
    pixels = _only_channel(attributes["channels"])
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    size = (bottom - top + 1, right - left + 1)
    return _Header(compression, pixels, top, size, position + 1)


def _only_channel(data: bytes) -> np.dtype[np.floating]:
    _, position = _string(data, 0)
    (kind,) = struct.unpack_from("<i", data, position)
    if data[position + 16] != 0:
        raise ValueError("it has several channels")
    if kind not in PIXELS:
        raise ValueError("its pixels are integers")
    return np.dtype(PIXELS[kind])


def _string(data: bytes, position: int) -> tuple[str, int]:
    end = data.index(b"\0", position)
    return data[position:end].decode("latin-1"), end + 1


def _read_blocks(data: bytes, header: _Header) -> NDArray[np.float32]:
    height, width = header.size
    lines = LINES_OF_BLOCK[header.compression]
    num = -(-height // lines)
    image = np.empty((height, width), np.float32)
    for offset in struct.unpack_from(f"<{num}q", data, header.end):
        row, length = struct.unpack_from("<2i", data, offset)
        row -= header.top
        block = image[row : row + lines]
        packed = data[offset + 8 : offset + 8 + length]
        stored = _unpack(packed, block.size * header.pixels.itemsize)
        block[:] = np.frombuffer(stored, header.pixels).reshape(block.shape)
    return image


def _unpack(packed: bytes, length: int) -> bytes:
    """Undo the compression: differences of bytes, the first half of them the even ones."""
    if len(packed) == length:
        return packed  # a block that would not shrink is kept as it is
    steps = np.frombuffer(zlib.decompress(packed), np.uint8).copy()
    if len(steps) != length:
        raise ValueError("a block has another length")
    steps[1:] -= np.uint8(128)
    mixed = np.cumsum(steps, dtype=np.uint8)
    out = np.empty(length, np.uint8)
    half = (length + 1) // 2
    out[0::2], out[1::2] = mixed[:half], mixed[half:]
    return out.tobytes()
