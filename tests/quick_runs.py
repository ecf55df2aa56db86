"""Runs without what takes most of their time in tests."""

import pytest

PICTURES, PAGE = ("draw_findings", "stages_picture"), ("write_report_page",)


def leave_pictures_out(patch: pytest.MonkeyPatch, *, page: bool = False) -> None:
    """Let runs draw no pictures; with ``page``, nor write their page."""
    for name in (*PICTURES, *(PAGE if page else ())):
        patch.setattr(f"laser_slam.pipeline.{name}", lambda *_, **__: None)
