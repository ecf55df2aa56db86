"""What each format needs of a run: asked before anything is written."""

from __future__ import annotations

from laser_slam.dependencies import import_laspy
from laser_slam.errors import RunFolderError
from laser_slam.export.base import Source
from laser_slam.export.las import parse_crs


def has_points(source: Source) -> None:
    """Ask for a map that is not empty, and for its coordinate system where it names one.

    Raises:
        RunFolderError: it is empty, or its files are damaged.
        ConfigError: the coordinate system is unknown, or not projected.
        DependencyError: pyproj, which knows these, is not installed.
    """
    crs = source.some_points().crs
    if crs is not None:
        parse_crs(crs)


def can_be_las(source: Source) -> None:
    """Ask for the packages that write LAS and LAZ, a map, and a coordinate system that exists.

    Raises:
        DependencyError: a package is not installed.
        RunFolderError: the map is empty, or its files are damaged.
        ConfigError: the coordinate system is unknown, or not projected.
    """
    import_laspy()
    has_points(source)


def has_keyframes(source: Source) -> None:
    """Ask for the places of the keyframes.

    Raises:
        RunFolderError: the run does not say which they are.
    """
    next(source.views(()), None)


def has_surface(source: Source) -> None:
    """Ask for what a mesh is made of: a map that is not empty, and keyframes.

    Raises:
        RunFolderError: the map is empty, or the run does not say which its keyframes are.
    """
    has_points(source)
    has_keyframes(source)


def has_photos(source: Source) -> None:
    """Ask for the images of the keyframes.

    Raises:
        DatasetError: they are missing.
        RunFolderError: the run does not say which they are.
    """
    source.photos()


def has_graph(source: Source) -> None:
    """Ask for the pose graph.

    Raises:
        RunFolderError: the run has none.
    """
    if source.graph is None:
        raise RunFolderError(
            f"{source.name} has no pose graph: it was run with closures.enabled=false; "
            "export its trajectory instead (kitti, tum, euroc)"
        )
