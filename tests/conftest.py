"""What several test modules share."""

import pytest
from rendered import RenderedDrive, render_drive


@pytest.fixture(scope="session")
def short_drive() -> RenderedDrive:
    """Two dozen rendered frames of a street with a bend; 20 m, 640 pixels wide."""
    return render_drive(24)
