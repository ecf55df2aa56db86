"""Where weights come from: a file of the user's, the hub's cache, the hub."""

from __future__ import annotations

import errno
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import torch
from torch import nn

from laser_slam.errors import DependencyError, WeightsError
from laser_slam.networks.weights import Checkpoint

logger = logging.getLogger(__name__)


def find_weights(setting_value: str, checkpoint: Checkpoint) -> Path:
    """Return the file of a network's weights; what is not on this machine is downloaded.

    Args:
        setting_value: the user's file; empty: from the Hugging Face hub, whose cache is asked
            first, so that nothing is sent where the file was downloaded before.
        checkpoint: what it should be.

    Raises:
        WeightsError: the file is not there and cannot be had; says what to put where.
        DependencyError: it is to be downloaded, and huggingface_hub is not installed.
    """
    if setting_value:
        file = Path(setting_value).expanduser()
        if not file.is_file():
            raise WeightsError(
                f"{checkpoint.setting}: no file '{setting_value}'; {checkpoint.advice} "
                "and give its path"
            )
        return file
    if not checkpoint.repo:
        raise WeightsError(f"{checkpoint.setting}: not set; {checkpoint.advice} and give its path")
    return _from_hub(checkpoint)


def hash_file(file: Path) -> str:
    """Return the SHA-256 of a file, as the hub lists it."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def hash_weights(network: nn.Module) -> str:
    """Return the SHA-256 of a network's weights, with their names, wherever they are."""
    digest = hashlib.sha256()
    for key, tensor in network.state_dict().items():
        digest.update(f"{key} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
    return digest.hexdigest()


def _from_hub(checkpoint: Checkpoint) -> Path:
    try:
        import huggingface_hub  # noqa: PLC0415  (not everyone downloads)
        import huggingface_hub.errors as kinds  # noqa: PLC0415
    except ImportError as error:
        raise DependencyError(
            f"{checkpoint.setting}: not set, and to download it huggingface_hub is missing "
            f"({error}): pip install 'laser-slam[networks]'; or {checkpoint.advice} "
            "and give its path"
        ) from error
    # The library's errors have no common root; HTTPError is that of its own HTTP library.
    names = ("HTTPError", "EntryNotFoundError", "XetDownloadError", "HFValidationError")
    known = tuple(getattr(kinds, name) for name in names if hasattr(kinds, name))
    try:
        return _download(huggingface_hub.hf_hub_download, checkpoint, kinds)
    except (*known, OSError, RuntimeError) as error:
        why = _explain(error, checkpoint, kinds)
        raise WeightsError(
            f"{checkpoint.setting}: not set, and {why}; {checkpoint.advice} "
            "(with a browser, on any machine) and give its path"
        ) from error


def _download(download: Callable[..., str], checkpoint: Checkpoint, kinds: ModuleType) -> Path:
    """Ask the cache, then the hub."""
    try:
        return Path(download(checkpoint.repo, checkpoint.file, local_files_only=True))
    except kinds.LocalEntryNotFoundError:
        logger.info(
            "downloading %s of %s (%s), once", checkpoint.file, checkpoint.repo, checkpoint.size
        )
    return Path(download(checkpoint.repo, checkpoint.file))


def _explain(error: Exception, checkpoint: Checkpoint, kinds: ModuleType) -> str:
    """Say what is wrong, in the user's terms."""
    repo = checkpoint.repo
    if isinstance(error, kinds.GatedRepoError):
        return f"{repo} is gated: accept its terms at {checkpoint.url}, then 'hf auth login'"
    if isinstance(error, kinds.RepositoryNotFoundError):
        return f"the hub has no {repo}, or wants a login for it: 'hf auth login'"
    # That nothing is found on this machine either is how the library says that it is offline.
    if isinstance(error, kinds.LocalEntryNotFoundError):
        return "the Hugging Face hub cannot be reached (no network, or HF_HUB_OFFLINE is set)"
    if isinstance(error, kinds.EntryNotFoundError):
        return f"{repo} has no {checkpoint.file} any more"
    return _explain_plainly(error, checkpoint)


def _explain_plainly(error: Exception, checkpoint: Checkpoint) -> str:
    """Say what is wrong with the machine; what is not known is quoted."""
    is_full = isinstance(error, OSError) and error.errno == errno.ENOSPC
    if is_full or "No space left" in str(error):
        return (
            f"the disk of the hub's cache has no room for {checkpoint.size}: "
            "free some, or name another folder in the environment variable HF_HOME"
        )
    first = (str(error).strip() or type(error).__name__).splitlines()[0][:120]
    if isinstance(error, OSError) and error.filename:
        return (
            f"the hub's cache cannot be used ({first}): "
            "name another folder in the environment variable HF_HOME"
        )
    return f"it cannot be downloaded ({first})"
