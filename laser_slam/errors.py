"""Errors that a user can mend; the command line prints them as one line."""


class LaserSlamError(Exception):
    """Stand for anything a user can mend; the text says what, where and what to do."""


class DatasetError(LaserSlamError):
    """The input sequence is missing, incomplete or unreadable."""


class ConfigError(LaserSlamError):
    """A setting is unknown, out of its limits or contradicts another."""


class RunFolderError(LaserSlamError):
    """The output folder cannot be used or written."""


class WeightsError(LaserSlamError):
    """The weights of a network are missing, unreadable or those of another network."""


class DependencyError(LaserSlamError):
    """A package or a system library that is needed for this is not installed."""


class DegenerateGeometryError(LaserSlamError):
    """The data do not determine what was asked: too few points, no motion, no overlap."""
