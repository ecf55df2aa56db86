"""What predictions were made with, and of which frames: so that no others are taken for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from laser_slam.config import Config
from laser_slam.errors import ConfigError, RunFolderError
from laser_slam.store import atomic_write, name_differences, write_text

FILE = "predictions.yaml"
FRAMES_FILE = "frames.npz"
SECTIONS = ("dataset", "windows", "calibration")  # of the settings: all that decide the windows


_Windows = Annotated[list[Annotated[list[int], Field(min_length=1)]], Field(min_length=1)]


@dataclass(frozen=True)
class Manifest:
    """What the predictions in a folder are.

    Attributes:
        backbone: its name in the settings.
        identity: what its predictions depend on beside the images, as it says itself.
        image_size: (height, width) of the images that it was given.
        settings: the sections that decide which frames make which window, and how they look.
        windows: rising frame indices of each window; None: they are not all there yet.
    """

    backbone: str
    identity: dict[str, Any]
    image_size: tuple[int, int]
    settings: dict[str, dict[str, Any]]
    windows: _Windows | None = None

    @property
    def made_by(self) -> dict[str, Any]:
        """Return what the predictions depend on beside the windows."""
        size = list(self.image_size)
        return {"backbone": self.backbone, "identity": self.identity, "image_size": size}

    def with_windows(self, windows: list[list[int]]) -> Manifest:
        """Return it for predictions that are all there."""
        return replace(self, windows=windows)

    def save(self, folder: Path) -> None:
        """Write it into the folder of the predictions.

        Raises:
            RunFolderError: the file cannot be written.
        """
        content = {**vars(self), "image_size": list(self.image_size)}
        write_text(folder / FILE, yaml.safe_dump(content, sort_keys=False, width=1000))


def settings_that_matter(config: Config) -> dict[str, dict[str, Any]]:
    """Return the sections of the settings that decide which frames make which window."""
    return {name: getattr(config, name).model_dump(mode="json") for name in SECTIONS}


def load_manifest(folder: Path) -> Manifest | None:
    """Read what the predictions in a folder are; None: no such file.

    Raises:
        RunFolderError: the file is damaged.
    """
    path = folder / FILE
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        return TypeAdapter(Manifest).validate_python(content)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise RunFolderError(f"{path} is damaged; predict into another folder") from error


def load_predictions(folder: str) -> Manifest:
    """Read what the predictions in a folder are, all of which must be there.

    Raises:
        ConfigError: no folder is named.
        RunFolderError: it holds no predictions, or not all of them.
    """
    if not folder:
        raise ConfigError(
            "backbone.replay.folder: not set; give what 'laser-slam predict' wrote, or a run"
        )
    found = load_manifest(Path(folder))
    if found is None:
        raise RunFolderError(
            f"no predictions in {folder}; give what 'laser-slam predict' wrote, or a run's folder"
        )
    if found.windows is None:
        raise RunFolderError(
            f"{folder} does not hold all predictions; the command that began it, with "
            f"--out {folder}, goes on"
        )
    return found


def refuse_others(
    folder: Path, stored: Mapping[str, Any], wanted: Mapping[str, Any], what: str
) -> None:
    """Refuse predictions that were made with something else than what is wanted now.

    Args:
        folder: of the predictions.
        stored: what they were made with.
        wanted: what is asked for.
        what: that differs, in the plural, for the error: 'settings', 'images', 'means'.

    Raises:
        RunFolderError: names what differs.
    """
    differences = name_differences(stored, wanted)
    if differences:
        advice = f"--config {folder / 'config.yaml'} takes theirs" if what == "settings" else ""
        raise RunFolderError(
            f"the predictions in {folder} were made with other {what}: {differences}; "
            f"{advice or 'predict anew, into another folder'}"
        )


def refuse_mixing(folder: Path, manifest: Manifest) -> Manifest | None:
    """Refuse to go on in a folder with predictions that were made by other means.

    Args:
        folder: of the run.
        manifest: of the predictions that would join those that are there.

    Returns:
        The manifest that is there; None: there is none.

    Raises:
        RunFolderError: names what differs.
    """
    stored = load_manifest(folder)
    if stored is not None:
        refuse_others(folder, stored.made_by, manifest.made_by, "means")
    return stored


def read_identity(folder: Path) -> dict[str, Any]:
    """Read which input the predictions in a folder are of.

    Raises:
        RunFolderError: the file is missing or damaged.
    """
    path = folder / "sequence.yaml"
    try:
        return dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, yaml.YAMLError) as error:
        raise RunFolderError(f"{path} is missing or damaged; predict anew elsewhere") from error


def save_frames(folder: Path, times_s: Iterable[float], unreadable: Iterable[int]) -> None:
    """Write the times of all frames of the input, and which of them could not be read.

    Raises:
        RunFolderError: the file cannot be written.
    """
    with atomic_write(folder / FRAMES_FILE) as partial, partial.open("wb") as file:
        np.savez(
            file,
            allow_pickle=False,
            times_s=np.array(list(times_s), np.float64),
            unreadable=np.array(list(unreadable), np.int64),
        )


def load_frames(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read the times of all frames in seconds, and the indices of those that were unreadable.

    Raises:
        RunFolderError: the file is missing or damaged.
    """
    path = folder / FRAMES_FILE
    try:
        with np.load(path, allow_pickle=False) as file:
            return file["times_s"], file["unreadable"]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise RunFolderError(f"{path} is missing or damaged; predict anew elsewhere") from error
