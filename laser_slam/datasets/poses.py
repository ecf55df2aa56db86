"""Numbers and camera poses out of text files, and what is no pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import DatasetError
from laser_slam.sim3 import orthonormal

Array = NDArray[np.float64]

MAX_SKEW = 1e-3  # how far a pose may be from a rotation


def rigid_or_none(world_from_cam: Array) -> Array | None:
    """Return a (4, 4) pose with an exact rotation; None: it is not finite or no rigid motion.

    Data sets write infinities, NaN or zeros where tracking was lost.
    """
    rotation = world_from_cam[:3, :3]
    is_rigid = (
        np.isfinite(world_from_cam).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_SKEW)
        and np.linalg.det(rotation) > 0
        and np.allclose(world_from_cam[3], [0, 0, 0, 1])
    )
    if not is_rigid:
        return None
    out = np.array(world_from_cam, dtype=np.float64)
    out[:3, :3] = orthonormal(rotation)
    return out


def read_pose(path: Path, advice: str) -> Array | None:
    """Read a (4, 4) pose from a text file; None: there is no file, or it holds no rigid motion.

    Raises:
        DatasetError: the file does not hold 16 numbers; ends with ``advice``.
    """
    if not path.is_file():
        return None
    return rigid_or_none(read_matrix(path, 4, advice))


def read_matrix(path: Path, rows: int, advice: str) -> Array:
    """Read (rows, 4) numbers, which need not be finite, from a text file.

    Raises:
        DatasetError: the file is missing, is no text, or holds something else.
    """
    try:
        numbers = np.array([float(part) for part in path.read_text(encoding="utf-8").split()])
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DatasetError(f"cannot read {path} ({reason}); {advice}") from error
    if numbers.shape != (rows * 4,):
        raise DatasetError(f"{path} must hold {rows}x4 numbers, got {len(numbers)}; {advice}")
    return numbers.reshape(rows, 4)


def read_rows(path: Path, advice: str) -> list[tuple[int, list[str]]]:
    """Read the lines of a text file that are neither empty nor comments (``#``), in words.

    Returns:
        The number of each line in the file, from 1, and its words.

    Raises:
        DatasetError: the file cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise DatasetError(f"cannot read {path} ({reason}); {advice}") from error
    split = ((number, line.split()) for number, line in enumerate(lines, start=1))
    return [(number, words) for number, words in split if words and not words[0].startswith("#")]


def matrix_of_words(path: Path, number: int, words: list[str], advice: str) -> Array:
    """Return the (4, 4) numbers, which need not be finite, of line ``number`` of a text file.

    Raises:
        DatasetError: it holds something else; ends with ``advice``.
    """
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (16,):
        raise DatasetError(f"line {number} of {path} must hold 4x4 numbers; {advice}")
    return numbers.reshape(4, 4)
