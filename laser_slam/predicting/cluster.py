"""The cluster that workers run in: reached, and divided among them."""

from __future__ import annotations

import logging
import socket
from dataclasses import dataclass
from typing import Any

from laser_slam.backbones import is_on_cpu
from laser_slam.config import BackboneConfig
from laser_slam.errors import ConfigError

CORES = 2  # of a worker without GPU
REACH_S = 10.0


@dataclass(frozen=True)
class Fleet:
    """Which workers there are to be.

    Attributes:
        address: of a Ray cluster, such as ``auto`` or ``ray://head:10001``; None: this machine.
        num_workers: None: one for each GPU, or as many as the cores allow.
            cores: that each worker gets; None: all that there are for each GPU, without GPUs 2.
    """

    address: str | None = None
    num_workers: int | None = None
    cores: int | None = None


def connect(ray: Any, address: str | None) -> None:
    """Join a cluster, or start one of this machine alone."""
    _refuse_unreachable(address)
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        if address is None:
            ray.init(include_dashboard=False, **quiet)
        else:
            ray.init(address=address, **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        where = "on this machine" if address is None else f"at {address}"
        raise ConfigError(
            f"--address: no Ray cluster {where} ({last_line(error)}); start one with "
            "'ray start --head'"
        ) from error


def _refuse_unreachable(address: str | None) -> None:
    """Say at once what Ray finds out after many minutes."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=REACH_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"--address: nothing answers at {address} ({error}); start a cluster there with "
            "'ray start --head'"
        ) from error


def divide(
    has: dict[str, float], fleet: Fleet, config: BackboneConfig
) -> tuple[dict[str, float], int]:
    """Return what Ray is asked for each worker, and how many there are to be."""
    cores, gpus = int(has.get("CPU", 1)), int(has.get("GPU", 0))
    if gpus and not is_on_cpu(config):
        needs = {"num_gpus": 1, "num_cpus": fleet.cores or max(1, cores // gpus)}
        num = fleet.num_workers or gpus
    else:
        needs = {"num_gpus": 0, "num_cpus": min(fleet.cores or CORES, cores)}
        num = fleet.num_workers or max(1, cores // int(needs["num_cpus"]))
    if num * needs["num_cpus"] > cores or num * needs["num_gpus"] > gpus:
        raise ConfigError(
            f"{num} workers of {needs['num_cpus']} cores and {needs['num_gpus']} GPUs; there are "
            f"{cores} cores and {gpus} GPUs: lower --workers or --cores"
        )
    return {**needs, "max_restarts": 0}, num


def last_line(error: Exception) -> str:
    """Return what an error says at its end, in one line."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip()[:200] if lines else type(error).__name__
