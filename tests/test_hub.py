"""Where weights come from, and what a user is told who cannot have them."""

import errno
import hashlib
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub
import huggingface_hub.errors as kinds
import pytest
import torch
from torch import nn

from laser_slam.errors import DependencyError, WeightsError
from laser_slam.networks import pi3, pi3x, vggt
from laser_slam.networks.hub import find_weights, hash_file, hash_weights
from laser_slam.networks.weights import Checkpoint

RELEASED = pi3.RELEASED
URL = "https://huggingface.co/yyfz233/Pi3"
Download = Callable[..., str]


def answer(status: int) -> Any:
    """Return an answer of the hub's server, as the library's own HTTP library puts it."""
    http = sys.modules[kinds.HfHubHTTPError.__mro__[1].__module__.split(".")[0]]
    if hasattr(http, "Response") and hasattr(http, "Request"):
        request = http.Request("GET", URL)
        return http.Response(status, request=request)
    pytest.skip("this version of huggingface_hub answers otherwise")


def failing(error: Exception) -> Download:
    """Return a download that finds nothing in the cache and fails on the way."""

    def download(repo: str, file: str, *, local_files_only: bool = False) -> str:
        assert (repo, file) == ("yyfz233/Pi3", "model.safetensors")
        if local_files_only:
            raise kinds.LocalEntryNotFoundError("not in the cache")
        raise error

    return download


def told(monkeypatch: pytest.MonkeyPatch, error: Exception) -> str:
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", failing(error))
    with pytest.raises(WeightsError) as caught:
        find_weights("", RELEASED)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("backbone.pi3.weights: not set, and ")
    assert f"download model.safetensors (3.84 GB, CC BY-NC 4.0) from {URL}" in text
    assert text.endswith(" and give its path")
    return text


def test_a_users_file_is_taken_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    file.write_bytes(b"weights")
    assert find_weights(str(file), RELEASED) == file
    assert hash_file(file) == hashlib.sha256(b"weights").hexdigest()


@pytest.mark.parametrize("name", ["nowhere.pt", "."])
def test_a_users_file_that_is_none_is_named_with_what_to_do(name: str) -> None:
    expected = f"backbone.pi3.weights: no file '{name}'; download model.safetensors (3.84 GB"
    with pytest.raises(WeightsError, match=re.escape(expected)):
        find_weights(name, RELEASED)


def test_the_cache_is_asked_before_the_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def download(repo: str, file: str, *, local_files_only: bool = False) -> str:
        asked.append(local_files_only)
        return "/cache/model.safetensors"

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    assert find_weights("", RELEASED) == Path("/cache/model.safetensors")
    assert asked == [True]


def test_what_the_cache_lacks_is_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def download(repo: str, file: str, *, local_files_only: bool = False) -> str:
        asked.append((repo, file, local_files_only))
        if local_files_only:
            raise kinds.LocalEntryNotFoundError("not in the cache")
        return "/cache/model.safetensors"

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    assert find_weights("", RELEASED) == Path("/cache/model.safetensors")
    assert asked[-1] == ("yyfz233/Pi3", "model.safetensors", False)


def test_without_network_one_line_says_which_file_to_bring(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    error = kinds.LocalEntryNotFoundError(
        "An error happened while trying to locate the file\non it"
    )
    assert "the Hugging Face hub cannot be reached (no network" in told(monkeypatch, error)


def test_offline_mode_and_a_broken_line_read_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    offline = kinds.OfflineModeIsEnabled("Cannot reach the hub: offline mode is enabled.")
    assert "it cannot be downloaded (Cannot reach the hub" in told(monkeypatch, offline)
    broken = ConnectionResetError(errno.ECONNRESET, "Connection reset by peer")
    assert "Connection reset by peer" in told(monkeypatch, broken)


def test_the_real_library_without_network_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(WeightsError) as caught:
        find_weights("", RELEASED)
    assert "the Hugging Face hub cannot be reached (no network" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cache_that_is_no_folder_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(repo: str, file: str, *, local_files_only: bool = False) -> str:
        raise NotADirectoryError(errno.ENOTDIR, "Not a directory", "/dev/null/x")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    with pytest.raises(WeightsError) as caught:
        find_weights("", RELEASED)
    text = str(caught.value)
    assert f"cannot be used ([Errno {errno.ENOTDIR}] Not a directory: '/dev/null/x'): name" in text
    assert "another folder in the environment variable HF_HOME; download model" in text
    assert "\n" not in text


def test_gated_weights_say_where_to_accept_their_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    error = kinds.GatedRepoError("401 Client Error", response=answer(401))
    text = told(monkeypatch, error)
    assert f"yyfz233/Pi3 is gated: accept its terms at {URL}, then 'hf auth login'" in text


def test_a_repository_that_is_not_there_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    error = kinds.RepositoryNotFoundError("404 Client Error", response=answer(404))
    assert "the hub has no yyfz233/Pi3, or wants a login for it" in told(monkeypatch, error)


def test_a_file_that_is_gone_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    error = kinds.RemoteEntryNotFoundError("404 Client Error", response=answer(404))
    assert "yyfz233/Pi3 has no model.safetensors any more" in told(monkeypatch, error)


def test_a_server_in_trouble_is_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    error = kinds.HfHubHTTPError("503 Server Error: Service Unavailable", response=answer(503))
    assert "it cannot be downloaded (503 Server Error" in told(monkeypatch, error)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        RuntimeError("Data processing error: I/O error: No space left on device (os error 28)"),
    ],
)
def test_a_full_disk_says_how_much_is_needed_and_where(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    assert "no room for 3.84 GB: free some, or name another folder in the" in told(
        monkeypatch, error
    )


def test_without_the_package_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match=r"pip install 'laser-slam\[networks\]'; or download"):
        find_weights("", RELEASED)


def test_weights_that_are_on_no_hub_must_be_given() -> None:
    alone = Checkpoint("a.setting", "tiny.pt", "https://example.org/tiny.pt", "1 MB", "CC0")
    with pytest.raises(WeightsError, match=r"a\.setting: not set; download tiny\.pt .* its path"):
        find_weights("", alone)


@pytest.mark.parametrize("module", [pi3, pi3x, vggt])
def test_every_network_is_on_the_hub(module: Any) -> None:
    released = module.RELEASED
    assert released.repo.count("/") == 1
    assert released.repo in released.advice
    assert released.setting == f"backbone.{module.__name__.rpartition('.')[2]}.weights"


def test_the_hash_of_weights_knows_values_names_and_kinds() -> None:
    torch.manual_seed(0)
    layer = nn.Linear(3, 4)
    first = hash_weights(layer)
    assert hash_weights(layer) == first
    assert hash_weights(nn.Sequential(layer)) != first
    assert hash_weights(layer.to(torch.bfloat16)) != first
    with torch.no_grad():
        layer.weight[0, 0] += 1
    assert len({first, hash_weights(layer)}) == 2
