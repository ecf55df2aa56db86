"""From a run's folder to files of other formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from laser_slam.errors import ConfigError, RunFolderError
from laser_slam.export import FORMATS, Source, check_replaceable, find_writer
from laser_slam.exporting.options import ExportOptions
from laser_slam.exporting.run import open_run


def export_run(
    run: Path,
    formats: Sequence[str],
    out: Path | None = None,
    options: ExportOptions | None = None,
) -> list[Path]:
    """Write a finished run in other formats; nothing is predicted again.

    Whatever can be refused is refused before anything is written.

    Args:
        run: the run's folder.
        formats: names from ``FORMATS``.
        out: the file or folder to be, of a single format; the folder that gets them all, of
            several; None: ``RUN/export``.
        options: None: the defaults.

    Returns:
        The files and folders that were written, in the order of ``formats``.

    Raises:
        ConfigError: an unknown format or setting, or options that contradict each other.
        DependencyError: a format needs an extra that is not installed.
        DatasetError: the original images are missing.
        RunFolderError: the run is not finished or damaged, something is there already, the map
            is empty, or a file cannot be written.
    """
    options = options or ExportOptions()
    names = list(dict.fromkeys(formats))
    if not names:
        raise ConfigError(f"--to: name a format; there is {', '.join(FORMATS)}")
    writers = {name: find_writer(name) for name in names}
    _check_georeference(names, options)
    source = open_run(run, options)
    targets = _targets(run, names, out)
    _refuse_impossible(targets, source, force=options.force)
    for name, target in targets.items():
        _make_parent(target)
        writers[name](target, source)
    return list(targets.values())


def _targets(run: Path, names: Sequence[str], out: Path | None) -> dict[str, Path]:
    """Say where each format goes."""
    if out is None:
        out = run / "export"
    elif len(names) == 1 and (FORMATS[names[0]].is_folder or not out.is_dir()):
        return {names[0]: out}
    return {name: out / FORMATS[name].target for name in names}


def _refuse_impossible(targets: Mapping[str, Path], source: Source, *, force: bool) -> None:
    for name, target in targets.items():
        _check_target(target, FORMATS[name].is_folder, force=force)
    for check in dict.fromkeys(FORMATS[name].check for name in targets):
        if check is not None:
            check(source)


def _check_target(target: Path, is_folder: bool, *, force: bool) -> None:
    """Refuse what would overwrite something that nobody asked to overwrite."""
    if not target.exists() or (is_folder and target.is_dir() and not any(target.iterdir())):
        return
    if target.is_dir() != is_folder:
        kind = "a folder" if target.is_dir() else "a file"
        raise RunFolderError(f"{target} is {kind}; choose another name with --out")
    if not force:
        raise RunFolderError(
            f"{target} is there already; replace it with --force, or choose another with --out"
        )
    if is_folder:
        check_replaceable(target)


def _make_parent(target: Path) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"cannot make the folder {target.parent}: {error.strerror}; choose another with --out"
        ) from error


def _check_georeference(names: Sequence[str], options: ExportOptions) -> None:
    if options.crs is not None and options.georeference is None:
        raise ConfigError(
            "--crs says in which system the map lies; add --georeference FILE to place it there"
        )
    others = [name for name in names if not FORMATS[name].is_cloud]
    if options.georeference is not None and others:
        clouds = ", ".join(name for name, item in FORMATS.items() if item.is_cloud)
        raise ConfigError(
            f"--georeference places clouds only ({clouds}); export {', '.join(others)} without it"
        )
