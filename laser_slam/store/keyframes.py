"""Where the keyframes of a finished run lie, and which images they are of."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.store.files import atomic_write, write_text
from laser_slam.types import NO_DISTORTION, Calibration, SequenceInfo

Array = NDArray[np.float64]

KEYFRAMES_FILE = "keyframes.npz"
IMAGES_FILE = "images.json"


@dataclass(frozen=True)
class Keyframes:
    """The keyframes of a finished run at their final places, each in the window that owns it.

    Attributes:
        frames: (K,) rising indices in the sequence.
        windows: (K,) index of the owner.
        world_from_window: (K, 4, 4) similarities: what maps the owner's depth to the world at
            this frame, with what closures have moved.
        world_from_cam: (K, 4, 4) rigid, in world units.

    Raises:
        ValueError: shapes disagree, frames do not rise or a number is not finite.
    """

    frames: NDArray[np.int64]
    windows: NDArray[np.int64]
    world_from_window: Array
    world_from_cam: Array

    def __post_init__(self) -> None:
        """Check shapes and values once, here."""
        num = len(self.frames)
        if self.windows.shape != (num,) or not (np.diff(self.frames) > 0).all():
            raise ValueError("each keyframe has one owner, and frames rise")
        for matrices in (self.world_from_window, self.world_from_cam):
            if matrices.shape != (num, 4, 4) or not np.isfinite(matrices).all():
                raise ValueError(f"{num} keyframes need as many finite 4x4 matrices")


@dataclass(frozen=True)
class Originals:
    """The images that a run was made of.

    Attributes:
        size: (height, width) in pixels.
        calibration: how their camera projects, as the run took it.
        files: the image of each frame; a single one: the video that all are of; empty: unknown.
    """

    size: tuple[int, int]
    calibration: Calibration
    files: tuple[Path, ...]


def save_keyframes(folder: Path, keyframes: Keyframes) -> None:
    """Write where the keyframes of a run lie into its folder.

    Raises:
        RunFolderError: the system could not write.
    """
    with atomic_write(folder / KEYFRAMES_FILE) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **vars(keyframes))


def load_keyframes(folder: Path) -> Keyframes:
    """Read what ``save_keyframes`` wrote.

    Raises:
        RunFolderError: the file is missing or damaged.
    """
    path = folder / KEYFRAMES_FILE
    try:
        with np.load(path, allow_pickle=False) as file:
            return Keyframes(**{field.name: file[field.name] for field in fields(Keyframes)})
    except FileNotFoundError as error:
        raise RunFolderError(
            f"{folder} has no {KEYFRAMES_FILE}: an older laser-slam made it; run it again"
        ) from error
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise RunFolderError(f"{path} is damaged: run again") from error


def save_originals(folder: Path, info: SequenceInfo, calibration: Calibration) -> None:
    """Write which images a run is of, and how their camera projects, into its folder.

    Raises:
        RunFolderError: the system could not write.
    """
    K = calibration.intrinsics
    content = {
        "size": list(info.size),
        "calibration": {
            "size": list(calibration.size),
            "intrinsics": None if K is None else K.tolist(),
            "distortion": calibration.distortion.tolist(),
            "source": calibration.source,
        },
        "files": [str(path.absolute()) for path in info.files],
    }
    write_text(folder / IMAGES_FILE, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def load_originals(folder: Path) -> Originals:
    """Read what ``save_originals`` wrote.

    Raises:
        RunFolderError: the file is missing or damaged.
    """
    path = folder / IMAGES_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        height, width = content["size"]
        return Originals(
            (int(height), int(width)),
            _calibration(content["calibration"]),
            tuple(Path(name) for name in content["files"]),
        )
    except FileNotFoundError as error:
        raise RunFolderError(
            f"{folder} has no {IMAGES_FILE}: an older laser-slam made it; run it again"
        ) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunFolderError(f"{path} is damaged: run again") from error


def _calibration(content: dict[str, object]) -> Calibration:
    K = content["intrinsics"]
    height, width = np.array(content["size"], np.int64).reshape(2).tolist()
    distortion = np.array(content["distortion"], np.float64).reshape(4)
    return Calibration(
        None if K is None else np.array(K, np.float64).reshape(3, 3),
        distortion if distortion.any() else NO_DISTORTION,
        (height, width),
        str(content["source"]),
    )
