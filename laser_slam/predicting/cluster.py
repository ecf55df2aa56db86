"""The cluster that workers run in: reached, and divided among them."""

from __future__ import annotations

import logging
import socket
from collections.abc import Mapping, Sequence
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
        address: of a Ray cluster that this machine is part of, ``auto`` or its ``HOST:PORT``;
            None: this machine alone.
        num_workers: None: one for each GPU, or as many as the cores allow.
        cores: that each worker gets; None: all that there are for each GPU; without GPUs, 2.
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
            ray.init(address="local", include_dashboard=False, **quiet)
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
    host, _, port = (address or "").rpartition(":")
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
    nodes: Sequence[Mapping[str, float]], fleet: Fleet, config: BackboneConfig
) -> tuple[dict[str, float], int]:
    """Return what Ray is asked for each worker, and how many there are to be.

    Args:
        nodes: what each machine has, as Ray calls it: CPU, GPU.
        fleet: which workers are wanted.
        config: of the backbone.

    Raises:
        ConfigError: more are wanted than the machines have room for.
    """
    room = [(int(node.get("CPU", 0)), int(node.get("GPU", 0))) for node in nodes]
    with_gpu = [(cores, gpus) for cores, gpus in room if gpus]
    if with_gpu and not is_on_cpu(config):
        each = fleet.cores or max(1, min(cores // gpus for cores, gpus in with_gpu))
        most = sum(min(gpus, cores // each) for cores, gpus in with_gpu)
        needs: dict[str, float] = {"num_gpus": 1, "num_cpus": each}
    else:
        each = fleet.cores or min(CORES, max((cores for cores, _ in room), default=1))
        most = sum(cores // each for cores, _ in room)
        needs = {"num_gpus": 0, "num_cpus": each}
    if not 1 <= (fleet.num_workers or most) <= most:
        raise ConfigError(
            f"{fleet.num_workers or 1} workers of {each} cores and {needs['num_gpus']} GPUs: there "
            f"is room for {most} on {len(room)} machines; lower --workers or --cores"
        )
    return {**needs, "max_restarts": 0}, fleet.num_workers or most


def last_line(error: Exception) -> str:
    """Return what an error says at its end, in one line."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip()[:200] if lines else type(error).__name__
