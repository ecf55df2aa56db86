"""Pose graphs in g2o's text format.

g2o's own type for Sim(3) is ``VERTEX_SIM3:EXPMAP`` with ``EDGE_SIM3:EXPMAP``: logarithms, order
rotation, translation, log-scale. In the file a vertex is ``world_from_window`` and an edge from a
to b is ``a_from_b`` (g2o inverts both as it reads), and the error of an edge is GTSAM's, so that
informations are the same numbers. ``VERTEX_SE3:QUAT`` with ``EDGE_SE3:QUAT`` has translation
before rotation, and the vector part of a quaternion, half a rotation vector, for its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from laser_slam.config import PoseGraphConfig
from laser_slam.dependencies import import_gtsam
from laser_slam.errors import DatasetError, DegenerateGeometryError
from laser_slam.pose_graph.graph import Link, PoseGraph
from laser_slam.pose_graph.tangent import DIMENSIONS, from_gtsam, to_gtsam
from laser_slam.sim3 import Sim3
from laser_slam.store import atomic_write

Array = NDArray[np.float64]

_NO_CAMERAS = "1 1 1 1 0 0 0 0"  # g2o: focal lengths and principal points of two cameras
_RIGID_SIGMA = 1e-6  # of the log-scale, where the file says that there is no scale
_UNIT_SCALE = 1e-9
# Rotation and translation of our order from translation and quaternion of SE3:QUAT.
_QUAT_FROM_OURS = np.block(
    [[np.zeros((3, 3)), np.eye(3)], [np.eye(3) / 2, np.zeros((3, 3))]],
)


def write_g2o(path: Path, graph: PoseGraph, *, rigid: bool = False) -> None:
    """Write windows, registrations and trusted closures.

    Args:
        path: of the file.
        graph: as it is after its last optimisation.
        rigid: write SE3:QUAT, which more programs read; what is known of the scale is lost.

    Raises:
        DegenerateGeometryError: ``rigid``, and a scale is not 1.
        RunFolderError: the folder is missing, cannot be written or is full.
    """
    chain, closures = graph.links
    places = graph.places
    if rigid:
        _refuse_scales([*places.values(), *(link.a_from_b for link in [*chain, *closures])])
    kind, values = ("SE3:QUAT", _quat_values) if rigid else ("SIM3:EXPMAP", _log_values)
    cameras = [] if rigid else [_NO_CAMERAS]
    lines = [
        " ".join([f"VERTEX_{kind} {index}", *_texts(values(place)), *cameras])
        for index, place in places.items()
    ]
    for link in [*chain, *closures]:
        information = _quat_information(link.information) if rigid else link.information
        upper = information[np.triu_indices(len(information))]
        texts = [*_texts(values(link.a_from_b)), *_texts(upper)]
        lines.append(" ".join([f"EDGE_{kind} {link.a} {link.b}", *texts]))
    with atomic_write(path) as partial:
        partial.write_text("\n".join([*lines, ""]), encoding="ascii")


def read_g2o(path: Path, config: PoseGraphConfig) -> PoseGraph:
    """Read a pose graph; edges between neighbouring vertices are registrations, others closures.

    Raises:
        DatasetError: the file is missing or no pose graph; says which line.
    """
    graph = PoseGraph(config)
    order: dict[int, int] = {}
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read the pose graph {path}: {error}") from error
    for number, line in enumerate(lines, start=1):
        tag, *words = line.split() or ["#"]
        if tag.startswith("#") or tag == "FIX":
            continue
        try:
            _read_line(graph, order, tag, words)
        except (ValueError, DegenerateGeometryError) as error:
            raise DatasetError(f"cannot read {path}, line {number}: {error}") from error
    return graph


def _read_line(graph: PoseGraph, order: dict[int, int], tag: str, words: list[str]) -> None:
    kind = tag.partition("_")[2]
    if kind not in ("SIM3:EXPMAP", "SE3:QUAT"):
        raise ValueError(f"{tag} is no vertex or edge of Sim(3) or SE(3)")
    if tag.startswith("VERTEX_"):
        index, values = int(words[0]), _numbers(words[1 : 1 + DIMENSIONS], DIMENSIONS)
        graph.add_window(index, _similarity(kind, values))
        order[index] = len(order)
        return
    size = DIMENSIONS if kind == "SIM3:EXPMAP" else DIMENSIONS - 1
    values = _numbers(words[2:], DIMENSIONS + size * (size + 1) // 2)
    information = np.zeros((size, size))
    information[np.triu_indices(size)] = values[DIMENSIONS:]
    information += np.triu(information, 1).T
    if kind == "SE3:QUAT":
        information = _full_information(information)
    a, b = int(words[0]), int(words[1])
    link = Link(a, b, _similarity(kind, values[:DIMENSIONS]), information)
    are_neighbours = abs(order.get(a, a) - order.get(b, b)) == 1
    graph.add_link(link, is_closure=not are_neighbours)


def _numbers(words: list[str], count: int) -> Array:
    if len(words) != count:
        raise ValueError(f"got {len(words)} numbers, need {count}")
    return np.array([float(word) for word in words])


def _similarity(kind: str, values: Array) -> Sim3:
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    if kind == "SE3:QUAT":
        return Sim3(1.0, Rotation.from_quat(values[3:]).as_matrix(), values[:3])
    return from_gtsam(import_gtsam().Similarity3.Expmap(values))


def _log_values(similarity: Sim3) -> Array:
    return np.asarray(import_gtsam().Similarity3.Logmap(to_gtsam(similarity)))


def _quat_values(similarity: Sim3) -> Array:
    quat_xyzw = Rotation.from_matrix(similarity.rotation).as_quat()
    return np.concatenate([similarity.translation, quat_xyzw])


def _quat_information(information: Array) -> Array:
    ours_from_quat = np.linalg.inv(_QUAT_FROM_OURS)
    return np.asarray(ours_from_quat.T @ information[:6, :6] @ ours_from_quat)


def _full_information(information: Array) -> Array:
    rigid = _QUAT_FROM_OURS.T @ information @ _QUAT_FROM_OURS
    return np.asarray(block_diag(rigid, _RIGID_SIGMA**-2))


def _texts(values: Array) -> list[str]:
    return [repr(float(value)) for value in values]


def _refuse_scales(similarities: Sequence[Sim3]) -> None:
    worst = max((s.scale for s in similarities), key=lambda scale: abs(scale - 1))
    if abs(worst - 1) > _UNIT_SCALE:
        raise DegenerateGeometryError(
            f"a graph without scales cannot hold the scale {worst:.6g}; write Sim(3) instead"
        )
