"""Files of the run folder: they appear whole or not at all."""

from __future__ import annotations

import errno
import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import yaml
from numpy.typing import NDArray

from laser_slam.config import Config, dump_config
from laser_slam.errors import RunFolderError
from laser_slam.types import Image, Prediction, WindowStatus

FORMAT_VERSION = 1
JPEG_QUALITY = 85

_ADVICE = {
    errno.ENOSPC: "free some space, or choose another folder",
    errno.EDQUOT: "free some space, or choose another folder",
    errno.EACCES: "make it writable, or choose another folder",
    errno.EROFS: "choose a folder that can be written",
    errno.ENOENT: "create its folder first",
}


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` that becomes ``path`` once it is whole.

    The temporary name ends as ``path`` does, for writers that choose the format by it. Whatever
    goes wrong inside, ``path`` stays as it was and no temporary file remains.

    Raises:
        RunFolderError: the system could not write, flush or rename; says what to do.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        _flush(partial)
        partial.replace(path)
    except OSError as error:
        advice = _ADVICE.get(error.errno or 0, "choose another folder")
        reason = error.strerror or str(error)
        raise RunFolderError(f"cannot write {path}: {reason}; {advice}") from error
    finally:
        with suppress(OSError):
            partial.unlink()


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def save_prediction(path: Path, prediction: Prediction, colors: Image) -> Prediction:
    """Write one window without pickle: the cache, the resume point and the replay's input.

    Depth is kept to a relative 5e-4, confidence in steps of 1/255, colours as JPEG; poses and
    intrinsics exactly. Depths beyond what float16 holds of the window's median become unknown.

    Args:
        path: the file to be, ``*.npz``.
        prediction: a backbone's view of the window.
        colors: (N, H, W, 3) RGB uint8, at the size of the depth maps.

    Returns:
        The prediction as ``load_prediction`` gives it back, so that a run that goes on with it
        ends as one that was broken off and resumed.

    Raises:
        RunFolderError: the system could not write.
    """
    packed = _pack(prediction)
    jpegs = [_encode_jpeg(image) for image in colors]
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez(
            file,
            allow_pickle=False,
            **packed,
            jpeg=np.frombuffer(b"".join(jpegs), np.uint8),
            jpeg_sizes=np.array([len(jpeg) for jpeg in jpegs], np.int64),
        )
    return _unpack(packed)


def load_prediction(path: Path) -> tuple[Prediction, Image]:
    """Read what ``save_prediction`` wrote.

    Returns:
        The prediction, and its (N, H, W, 3) RGB uint8 colours.

    Raises:
        RunFolderError: the file is missing, damaged or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        version = int(arrays["version"])
        if version == FORMAT_VERSION:
            return _unpack(arrays), _decode_jpegs(arrays["jpeg"], arrays["jpeg_sizes"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise RunFolderError(
            f"cannot read window file {path}: {text}; delete it and run again"
        ) from error
    raise RunFolderError(
        f"window file {path} has format {version}, this laser-slam reads {FORMAT_VERSION}; "
        "delete its run folder and run again"
    )


def _pack(prediction: Prediction) -> dict[str, NDArray[Any]]:
    known = prediction.depth[prediction.depth > 0]
    unit = float(np.median(known)) if known.size else 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (prediction.depth / np.float32(unit)).astype(np.float16)
        # Outside float16's normal range the relative error would be anything.
        lost = ~(np.isfinite(depth) & (np.abs(depth) >= np.finfo(np.float16).tiny))
    depth[lost] = np.nan
    confidence = np.where(lost, 0, np.rint(prediction.confidence * 255)).astype(np.uint8)
    return {
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
    )


def _encode_jpeg(image: Image) -> bytes:
    buffer = io.BytesIO()
    PIL.Image.fromarray(image).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def _decode_jpegs(data: Image, sizes: NDArray[np.int64]) -> Image:
    parts = np.split(data, np.cumsum(sizes)[:-1])
    return np.stack([np.asarray(PIL.Image.open(io.BytesIO(part.tobytes()))) for part in parts])


def new_run_folder(name: str, runs: Path = Path("runs")) -> Path:
    """Name a run's folder that is not there yet: ``runs/<name>-<time>``."""
    stem = f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    candidates = (runs / (stem + suffix) for suffix in ["", *(f"-{i}" for i in range(2, 1000))])
    return next(path for path in candidates if not path.exists())


def link_latest(folder: Path) -> None:
    """Let ``latest``, beside the run's folder, link to it; where links cannot be made, skip it."""
    link = folder.parent / "latest"
    partial = folder.parent / f".latest.{os.getpid()}.partial"
    with suppress(OSError):
        partial.symlink_to(folder.name, target_is_directory=True)
        partial.replace(link)
    with suppress(OSError):
        partial.unlink()


def open_run_folder(folder: Path, config: Config, sequence: Mapping[str, Any]) -> bool:
    """Create a run's folder, or take up the one of a run that was broken off.

    Args:
        folder: the run's folder; its parents are created too.
        config: resolved settings of the run.
        sequence: what tells the input from another one; plain YAML values.

    Returns:
        True when a run was broken off here, with the same settings and input.

    Raises:
        RunFolderError: no folder, not writable, not empty, a finished run, or a run with other
            settings or input; names what differs.
    """
    is_resumed = _is_broken_off_run(folder)
    if is_resumed:
        settings = config.model_dump(mode="json")
        _refuse_difference(folder / "config.yaml", settings, "settings")
        _refuse_difference(folder / "sequence.yaml", dict(sequence), "input")
    try:
        (folder / "windows").mkdir(parents=True, exist_ok=True)
        (folder / "pictures").mkdir(exist_ok=True)
        for partial in folder.rglob(".*.partial*"):  # of a run that was killed
            partial.unlink()
    except OSError as error:
        raise RunFolderError(
            f"cannot use {folder} as run folder: {error.strerror}; choose another with --out"
        ) from error
    # The settings come last: a folder that has them is a run.
    write_text(folder / "sequence.yaml", yaml.safe_dump(dict(sequence), sort_keys=False))
    write_text(folder / "config.yaml", dump_config(config))
    return is_resumed


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all.

    Raises:
        RunFolderError: the system could not write.
    """
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _is_broken_off_run(folder: Path) -> bool:
    try:
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
        names = {name for name in names if not name.startswith(".")}
    except NotADirectoryError as error:
        raise RunFolderError(f"{folder} is a file; choose a folder with --out") from error
    except OSError as error:
        raise RunFolderError(f"cannot read {folder}: {error.strerror}") from error
    if "report.json" in names:
        raise RunFolderError(
            f"{folder} holds a finished run; choose another folder with --out, or remove this one"
        )
    is_run = {"config.yaml", "sequence.yaml"} <= names
    if not is_run and names - _OF_AN_EARLY_END:
        raise RunFolderError(
            f"{folder} is neither empty nor a run folder; choose another with --out"
        )
    return is_run


_OF_AN_EARLY_END = {"sequence.yaml", "windows", "pictures", "run.log"}


def _refuse_difference(path: Path, wanted: dict[str, Any], what: str) -> None:
    try:
        stored = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RunFolderError(f"cannot read {path}; remove {path.parent} and run again") from error
    old, new = dict(_flatten(stored)), dict(_flatten(wanted))
    keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    if keys:
        listed = ", ".join(f"{key} ({old.get(key)}, now {new.get(key)})" for key in keys[:5])
        more = f" and {len(keys) - 5} more" if len(keys) > 5 else ""
        raise RunFolderError(
            f"{path.parent} holds a run with other {what}: {listed}{more}; "
            "choose another folder with --out"
        )


def _flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(settings, dict):
        yield prefix, settings
        return
    for key, value in settings.items():
        yield from _flatten(value, f"{prefix}.{key}" if prefix else str(key))
