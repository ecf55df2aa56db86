"""Packages whose import needs help."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any

from laser_slam.errors import ConfigError, DependencyError


@cache
def import_open3d() -> Any:
    """Import Open3D, whose wheel expects libusb on the system, which a new machine lacks.

    A missing libusb is taken from the ``libusb-package`` wheel. Everything else must be there.

    Raises:
        DependencyError: Open3D or a system library that it needs is missing; says how to get it.
    """
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        _preload_libusb()
    try:
        import open3d  # noqa: PLC0415  (slow, and not every command needs it)
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"Open3D cannot be loaded ({error}); install it and its system libraries: "
            "pip install open3d; apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"
        ) from error
    return open3d


@cache
def import_gtsam() -> Any:
    """Import GTSAM, whose Sim(3) factors exist since 4.3 only.

    Raises:
        DependencyError: GTSAM is missing, cannot be loaded or is too old; says how to get it.
    """
    try:
        import gtsam  # noqa: PLC0415  (slow, and only the pose graph needs it)

        _ = gtsam.BetweenFactorSimilarity3  # since 4.3
    except (ImportError, OSError, AttributeError) as error:
        raise DependencyError(
            f"GTSAM cannot be loaded or is too old ({error}); install it: pip install 'gtsam>=4.3'"
        ) from error
    return gtsam


@cache
def import_torch() -> Any:
    """Import PyTorch, which only networks need and a plain installation lacks.

    Raises:
        DependencyError: PyTorch is missing or cannot be loaded; says how to get it.
    """
    try:
        import torch  # noqa: PLC0415  (seconds, and only networks need it)
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"PyTorch cannot be loaded ({error}); install it: pip install 'laser-slam[networks]' "
            "(without a GPU, a much smaller one: --extra-index-url "
            "https://download.pytorch.org/whl/cpu)"
        ) from error
    return torch


@cache
def import_laspy() -> Any:
    """Import laspy, with the packages for LAZ and coordinate systems that belong to the extra.

    Raises:
        DependencyError: one of them is missing; says how to get it.
    """
    try:
        import laspy  # noqa: PLC0415  (an extra)

        for companion in ("lazrs", "pyproj"):
            import_module(companion)
    except ImportError as error:
        raise DependencyError(
            f"LAS and LAZ need laspy, lazrs and pyproj ({error}); "
            "install them: pip install 'laser-slam[las]'"
        ) from error
    return laspy


@cache
def import_rerun() -> Any:
    """Import rerun, which only the viewer needs and a plain installation lacks.

    Raises:
        DependencyError: rerun is missing, cannot be loaded or is too old; says how to get it.
    """
    try:
        import rerun  # noqa: PLC0415  (slow, and only the viewer needs it)

        _ = rerun.CoordinateFrame, rerun.RecordingStream.set_log_time_enabled
    except (ImportError, OSError, AttributeError) as error:
        raise DependencyError(
            f"rerun cannot be loaded or is too old ({error}); install it: "
            "pip install 'laser-slam[viewer]'"
        ) from error
    return rerun


@cache
def import_ray() -> Any:
    """Import Ray, which only predicting on several GPUs or machines needs.

    Raises:
        DependencyError: Ray is missing or cannot be loaded; says how to get it.
    """
    try:
        import ray  # noqa: PLC0415  (seconds, and only a fleet needs it)
        import ray.exceptions  # noqa: PLC0415
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"Ray cannot be loaded ({error}); install it: pip install 'laser-slam[ray]'"
        ) from error
    return ray


@cache
def import_kiss_icp() -> Any:
    """Import KISS-ICP's odometry, which only the LiDAR reference needs.

    Returns:
        The package, with its modules ``kiss_icp`` and ``config``.

    Raises:
        DependencyError: it is missing, cannot be loaded or is too old; says how to get it.
    """
    try:
        import kiss_icp  # noqa: PLC0415  (an extra)

        import_module("kiss_icp.config")
        _ = import_module("kiss_icp.kiss_icp").KissICP.register_frame
    except (ImportError, OSError, AttributeError) as error:
        raise DependencyError(
            f"KISS-ICP cannot be loaded ({error}); install it: pip install 'laser-slam[lidar]'"
        ) from error
    return kiss_icp


def num_threads() -> int:
    """Return how many threads are worth having: as OMP_NUM_THREADS says, or one for each core."""
    told = os.environ.get("OMP_NUM_THREADS", "")
    if told.isdecimal() and int(told):
        return int(told)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _preload_libusb() -> None:
    try:
        import libusb_package  # noqa: PLC0415
    except ImportError:
        return
    path = libusb_package.get_library_path()
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


def import_named(
    table: Mapping[str, str], name: str, setting: str, others: Sequence[str] = ()
) -> Any:
    """Import what a setting names.

    Args:
        table: name to ``module:attribute``.
        name: that was chosen.
        setting: as ``section.key``, for the error.
        others: names that the setting may have beside those of the table.

    Raises:
        ConfigError: the table has no such name.
    """
    if name not in table:
        raise ConfigError(f"{setting}: no '{name}'; there is {', '.join([*table, *others])}")
    module, _, attribute = table[name].partition(":")
    return getattr(import_module(module), attribute)
