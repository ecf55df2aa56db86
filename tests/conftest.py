"""What several test modules share."""

from collections.abc import Iterator

import pytest
from rendered import RenderedDrive, render_drive


@pytest.fixture(scope="session")
def short_drive() -> RenderedDrive:
    """Two dozen rendered frames of a street with a bend; 20 m, 640 pixels wide."""
    return render_drive(24)


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Leave waiting threads out: what is computed here is tiny."""
    import torch  # noqa: PLC0415  (seconds, and few tests need it)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
