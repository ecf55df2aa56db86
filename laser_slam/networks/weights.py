"""Weights from a file, all of them or none: no key is missing, unknown or of another shape."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor, nn

from laser_slam.errors import DependencyError, WeightsError

WRAPPERS = ("state_dict", "model")  # names under which training frameworks keep the tensors
ROUNDING = 0.01  # of a constant in half precision, and more than that
NUM_NAMED = 3  # keys of a kind that an error names
# Numbers that stand for themselves; narrower ones want scales, which lie elsewhere in a file.
FLOATING = {torch.float16, torch.bfloat16, torch.float32, torch.float64}


@dataclass(frozen=True)
class Checkpoint:
    """Where a user gets the weights of a network.

    Attributes:
        setting: that names the file.
        file: its usual name.
        url: where it is published.
        size: of the file, with its unit.
        licence: of the weights.
        repo: on the Hugging Face hub that has the file; empty: it is not there.
    """

    setting: str
    file: str
    url: str
    size: str
    licence: str
    repo: str = ""

    @property
    def advice(self) -> str:
        """Return what to do, in a few words."""
        return f"download {self.file} ({self.size}, {self.licence}) from {self.url}"


def load_weights(
    module: nn.Module,
    path: str,
    checkpoint: Checkpoint,
    *,
    unused: Sequence[str] = (),
    constants: Mapping[str, Sequence[float]] | None = None,
    dtype: torch.dtype | Callable[[str], torch.dtype] = torch.float32,
) -> None:
    """Give a network the tensors of a file, which become its own without another copy.

    Args:
        module: the network, on any device; best made on the meta device, which costs nothing.
            Buffers that are not in the file must not be on it.
        path: a .safetensors file, or what ``torch.save`` wrote (.pt, .pth, .ckpt).
        checkpoint: what the file should be, for the error.
        unused: keys of the file that the network has no place for; one that ends in a dot stands
            for all that begin with it.
        constants: keys of the file, if they are there, whose values the network has built in.
        dtype: that the weights get, one for all or by their keys; the file may hold another of
            ``FLOATING``.

    Raises:
        WeightsError: no such file, not readable, or of another network.
        DependencyError: the file is .safetensors and that package is not installed.
    """
    file = Path(path).expanduser()
    if not path or not file.is_file():
        found = f"no file '{path}'" if path else "not set"
        raise WeightsError(f"{checkpoint.setting}: {found}; {checkpoint.advice} and give its path")
    with _told_as_weights_error(file, checkpoint):
        tensors = read_tensors(file, dtype)
    below = tuple(name for name in unused if name.endswith("."))
    for key in [key for key in tensors if key in unused or key.startswith(below)]:
        del tensors[key]
    others = [] if constants is None else _pop_constants(tensors, constants)
    differences = find_differences(module.state_dict(), tensors)
    if others:
        differences = ", ".join(
            [*filter(None, [differences]), _name_some(others, "of other values")]
        )
    if differences:
        raise WeightsError(
            f"{file} is no {checkpoint.file}: {differences}; {checkpoint.advice} "
            f"and give its path as {checkpoint.setting}"
        )
    module.load_state_dict(tensors, assign=True)


def read_tensors(
    file: Path, dtype: torch.dtype | Callable[[str], torch.dtype]
) -> dict[str, Tensor]:
    """Read all tensors of a file; those ``FLOATING`` become ``dtype``, one by one to save memory.

    Nothing but tensors is ever unpickled.
    """
    is_safe = file.suffix == ".safetensors"
    pairs = _read_safetensors(file) if is_safe else _read_torch(file).items()
    return {
        key: value.to(dtype(key) if callable(dtype) else dtype)
        if value.dtype in FLOATING
        else value
        for key, value in pairs
    }


def find_differences(wanted: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> str:
    """Say in one line how the keys, shapes and kinds of two tables differ; empty: not at all."""
    shared = [key for key in wanted if key in found]
    shapes = [
        f"{key} {tuple(found[key].shape)} for {tuple(wanted[key].shape)}"
        for key in shared
        if found[key].shape != wanted[key].shape
    ]
    others = [
        f"{key} {found[key].dtype}"
        for key in shared
        if wanted[key].is_floating_point() and found[key].dtype not in FLOATING
    ]
    kinds = {
        "missing": [key for key in wanted if key not in found],
        "unexpected": [key for key in found if key not in wanted],
        "of another shape": shapes,
        "not floating": others,
    }
    return ", ".join(_name_some(keys, kind) for kind, keys in kinds.items() if keys)


def _pop_constants(
    tensors: dict[str, Tensor], constants: Mapping[str, Sequence[float]]
) -> list[str]:
    """Remove constants from a table and return the keys of those that differ."""
    others = []
    for key in constants.keys() & tensors.keys():
        found, built_in = tensors.pop(key).flatten().double(), torch.tensor(constants[key]).double()
        is_same = found.shape == built_in.shape and torch.allclose(found, built_in, rtol=ROUNDING)
        if not is_same:
            others.append(key)
    return sorted(others)


def _name_some(keys: Sequence[str], kind: str) -> str:
    more = ", ..." if len(keys) > NUM_NAMED else ""
    return f"{len(keys)} {kind} ({', '.join(keys[:NUM_NAMED])}{more})"


def _read_safetensors(file: Path) -> Iterator[tuple[str, Tensor]]:
    try:
        from safetensors import safe_open  # noqa: PLC0415  (not every network needs it)
    except ImportError as error:
        raise DependencyError(
            f"{file} needs safetensors ({error}); install it: pip install 'laser-slam[networks]'"
        ) from error
    with safe_open(file, framework="pt") as opened:
        for key in opened.keys():
            yield key, opened.get_tensor(key)


def _read_torch(file: Path) -> dict[str, Tensor]:
    # Only the newer, zipped form can be read as needed; the mapping lasts while its tensors do.
    content = torch.load(file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file))
    while isinstance(content, dict) and (inner := _wrapped(content)) is not None:
        content = inner
    if not isinstance(content, dict) or not all(
        isinstance(key, str) and torch.is_tensor(value) for key, value in content.items()
    ):
        raise ValueError("it holds no table of tensors")
    return content


def _wrapped(content: dict[str, object]) -> dict[str, object] | None:
    tables = (content.get(name) for name in WRAPPERS)
    return next((table for table in tables if isinstance(table, dict)), None)


@contextmanager
def _told_as_weights_error(file: Path, checkpoint: Checkpoint) -> Iterator[None]:
    """Turn what readers raise of a broken or foreign file into one line."""
    try:
        yield
    except UnpicklingError as error:
        why = "it holds other Python objects than tensors, or is no checkpoint"
        raise WeightsError(f"{file} is not read: {why}; {checkpoint.advice}") from error
    except _unreadable() as error:
        first = (str(error).strip() or type(error).__name__).splitlines()[0][:120]
        raise WeightsError(
            f"{file} is not read, it may be cut off ({first}); {checkpoint.advice}"
        ) from error


def _unreadable() -> tuple[type[Exception], ...]:
    """Return what the readers raise of a broken file."""
    errors = (OSError, ValueError, RuntimeError, EOFError)
    try:
        from safetensors import SafetensorError  # noqa: PLC0415
    except ImportError:
        return errors
    return (*errors, SafetensorError)
