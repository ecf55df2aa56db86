"""What a backbone said of each window, and what became of its layers: one file each."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from laser_slam.errors import RunFolderError
from laser_slam.store.files import atomic_write
from laser_slam.types import Image, Layers, Prediction, WindowStatus

FORMAT_VERSION = 1
JPEG_QUALITY = 85
# What a damaged archive makes its reader raise; RuntimeError: for flags that zipfile knows not.
_DAMAGE = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)


def save_prediction(path: Path, prediction: Prediction, colors: Image) -> tuple[Prediction, Image]:
    """Write one window without pickle: the cache, the resume point and the replay's input.

    Depth is kept to a relative 5e-4, confidence in steps of 1/255, colours as JPEG; poses and
    intrinsics exactly. Depths beyond what float16 holds of the window's median become unknown.

    Args:
        path: the file to be, ``*.npz``.
        prediction: a backbone's view of the window.
        colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.

    Returns:
        Both as ``load_prediction`` gives them back, so that a run that goes on with them ends as
        one that was broken off and resumed.

    Raises:
        RunFolderError: the system could not write.
    """
    arrays = _pack_window(prediction, colors)
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    return _unpack_window(arrays)


def pack_window(prediction: Prediction, colors: Image) -> bytes:
    """Return what ``save_prediction`` would write, to be sent elsewhere."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **_pack_window(prediction, colors))
    return file.getvalue()


def load_prediction(path: Path) -> tuple[Prediction, Image]:
    """Read what ``save_prediction`` wrote.

    Returns:
        The prediction, and its (N, H, W, 3) RGB uint8 colours.

    Raises:
        RunFolderError: the file is missing, damaged or of another version.
    """
    with _reading(path):
        return _unpack_window(_arrays_of(path))


def save_layers(path: Path, layers: Layers) -> None:
    """Write the layers of one window, beside its depth as it was predicted.

    Args:
        path: the file to be, ``*.npz``.
        layers: of the window.

    Raises:
        RunFolderError: the system could not write.
    """
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, version=np.array(FORMAT_VERSION), **vars(layers)
        )


def load_layers(path: Path) -> Layers:
    """Read what ``save_layers`` wrote.

    Raises:
        RunFolderError: the file is missing, damaged or of another version.
    """
    with _reading(path):
        arrays = _arrays_of(path)
        return Layers(**{field.name: arrays[field.name] for field in fields(Layers)})


class WindowFiles:
    """The files of all windows of a run, by the windows' indices.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, index: int) -> bool:
        """Tell whether a window was predicted before."""
        return self._path("windows", index).exists()

    def save(self, index: int, prediction: Prediction, colors: Image) -> tuple[Prediction, Image]:
        """Write a window; see ``save_prediction``."""
        return save_prediction(self._path("windows", index), prediction, colors)

    def write(self, index: int, content: bytes) -> None:
        """Write a window's file as ``pack_window`` has made it.

        Raises:
            RunFolderError: the system could not write.
        """
        with atomic_write(self._path("windows", index)) as partial:
            partial.write_bytes(content)

    def adopt(self, index: int, other: WindowFiles) -> None:
        """Take a window's file from another folder: by a link where that can be, else a copy.

        Raises:
            RunFolderError: there is no such file, or the system could not write.
        """
        ours, theirs = self._path("windows", index), other._path("windows", index)
        if not theirs.exists():
            raise RunFolderError(f"no window file {theirs}: predict it again")
        with atomic_write(ours) as partial:
            try:
                os.link(theirs, partial)
            except OSError:
                shutil.copyfile(theirs, partial)

    def load(self, index: int, frames: NDArray[np.int64] | None = None) -> tuple[Prediction, Image]:
        """Read a window back; see ``load_prediction``.

        Args:
            index: of the window.
            frames: (N,) that it must hold; None: whatever it holds.

        Raises:
            RunFolderError: also when it holds other frames.
        """
        path = self._path("windows", index)
        prediction, colors = load_prediction(path)
        if frames is not None and not np.array_equal(prediction.frames, frames):
            raise RunFolderError(
                f"{path} holds other frames than window {index} of this input; "
                "choose another folder with --out"
            )
        return prediction, colors

    def stamp(self, index: int) -> str:
        """Sum up the files of a window: differs when one was written anew with other content.

        Raises:
            RunFolderError: the window was not predicted.
        """
        path, layers = self._path("windows", index), self._path("layers", index)
        digest = hashlib.blake2b(digest_size=16)
        with _reading(path):
            stat = path.stat()
            digest.update(f"{stat.st_size} {stat.st_mtime_ns}".encode())
        if layers.exists():  # small, and written again by each run that goes on
            digest.update(layers.read_bytes())
        return digest.hexdigest()

    def load_depth(self, index: int) -> Prediction:
        """Read a window back without its colours; see ``load_prediction``."""
        path = self._path("windows", index)
        with _reading(path):
            return _unpack(_arrays_of(path))

    def save_layers(self, index: int, layers: Layers) -> None:
        """Write a window's layers; see ``save_layers``."""
        save_layers(self._path("layers", index), layers)

    def load_layers(self, index: int) -> Layers:
        """Read a window's layers back; see ``load_layers``."""
        return load_layers(self._path("layers", index))

    def _path(self, kind: str, index: int) -> Path:
        return self._folder / kind / f"{index:06d}.npz"


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Say of what is wrong with a file that it is this file, and what to do."""
    try:
        yield
    except _DAMAGE as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise RunFolderError(
            f"cannot read window file {path}: {text}; delete it and run again"
        ) from error


def _arrays_of(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    version = int(arrays["version"])
    if version != FORMAT_VERSION:
        raise RunFolderError(
            f"window file {path} has format {version}, this laser-slam reads {FORMAT_VERSION}; "
            "delete its run folder and run again"
        )
    return arrays


def _pack_window(prediction: Prediction, colors: Image) -> dict[str, NDArray[Any]]:
    jpegs = [_encode_jpeg(image) for image in colors]
    jpeg = np.frombuffer(b"".join(jpegs), np.uint8)
    sizes = np.array([len(each) for each in jpegs], np.int64)
    return {**_pack(prediction), "jpeg": jpeg, "jpeg_sizes": sizes}


def _unpack_window(arrays: dict[str, NDArray[Any]]) -> tuple[Prediction, Image]:
    return _unpack(arrays), _decode_jpegs(arrays["jpeg"], arrays["jpeg_sizes"])


def _pack(prediction: Prediction) -> dict[str, NDArray[Any]]:
    known = prediction.depth[prediction.depth > 0]
    unit = float(np.median(known)) if known.size else 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (prediction.depth / np.float32(unit)).astype(np.float16)
        # Outside float16's normal range the relative error would be anything.
        lost = ~(np.isfinite(depth) & (np.abs(depth) >= np.finfo(np.float16).tiny))
    depth[lost] = np.nan
    confidence = np.where(lost, 0, np.rint(prediction.confidence * 255)).astype(np.uint8)
    tokens = {} if prediction.tokens is None else {"tokens": prediction.tokens.astype(np.float32)}
    return {
        **tokens,
        "version": np.array(FORMAT_VERSION),
        "frames": prediction.frames,
        "depth": depth,
        "unit": np.array(unit),
        "confidence": confidence,
        "window_from_cam": prediction.window_from_cam,
        "intrinsics": prediction.intrinsics,
        "status": np.array(prediction.status.value),
        "warnings": np.array(prediction.warnings, dtype=np.str_),
    }


def _unpack(arrays: dict[str, NDArray[Any]]) -> Prediction:
    return Prediction(
        frames=arrays["frames"],
        depth=arrays["depth"].astype(np.float32) * np.float32(arrays["unit"]),
        confidence=arrays["confidence"].astype(np.float32) / np.float32(255),
        window_from_cam=arrays["window_from_cam"],
        intrinsics=arrays["intrinsics"],
        status=WindowStatus(str(arrays["status"])),
        warnings=tuple(str(warning) for warning in arrays["warnings"]),
        tokens=arrays.get("tokens"),
    )


def _encode_jpeg(image: Image) -> bytes:
    buffer = io.BytesIO()
    PIL.Image.fromarray(image).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def _decode_jpegs(data: Image, sizes: NDArray[np.int64]) -> Image:
    parts = np.split(data, np.cumsum(sizes)[:-1])
    return np.stack([np.asarray(PIL.Image.open(io.BytesIO(part.tobytes()))) for part in parts])
