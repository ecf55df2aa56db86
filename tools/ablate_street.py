"""Judge layer-wise scale alignment on distorted street scenes, before and after.

python tools/ablate_street.py                                          the defaults, all cases
python tools/ablate_street.py --config default --config paper --config official
python tools/ablate_street.py --config default --config default,layers.curve=false
python tools/ablate_street.py --cases objects --change unit=0.01,1,100
python tools/ablate_street.py --cases outliers --change outlier_confidence=0.5
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from street import CASES, KITTI_SIZE, TALL_SIZE, Case, Pair, make_pair, rotation_error_deg, score

from laser_slam.config import Config, load_config
from laser_slam.errors import LaserSlamError
from laser_slam.layers import align_layers, apply_layers, first_layers, make_segmenter
from laser_slam.registration import register

Array = NDArray[np.float64]

COLUMNS = (
    "case",
    "settings",
    "scale off %",
    "rotation off °",
    "AbsRel overlap",
    "AbsRel new",
    "layers overlap",
    "layers new",
    "layers/frame",
)


# The first window of a street is the truth but for noise. The default settings take a window for
# one opinion among many, so they must be told; with 1 they correct half of what they see.
TRUTH = 1e6


@dataclass(frozen=True)
class Row:
    """One case under one set of settings.

    Attributes:
        case: its name, with what was changed.
        settings: as given on the command line.
        figures: (10,) scale and rotation error, then before and after of AbsRel and of the layer
            error, each in the overlap and in new frames, and layers per frame at last.
    """

    case: str
    settings: str
    figures: Array

    def cells(self) -> list[str]:
        """Write the row as the table shows it."""
        scale, turn, *errors, layers = self.figures.tolist()
        arrows = [f"{a:.4f} → {b:.4f}" for a, b in zip(errors[::2], errors[1::2], strict=True)]
        return [self.case, self.settings, f"{scale:.2f}", f"{turn:.3f}", *arrows, f"{layers:.1f}"]


def measure(pair: Pair, config: Config, witnesses: float) -> Array:
    """Register and align the second window of a pair; return the figures of a row.

    Args:
        pair: the windows and the truth.
        config: all settings.
        witnesses: windows that the first one stands for.
    """
    registration = register(pair.previous, pair.current, config.registration)
    scale = registration.previous_from_current.scale
    segmenter = make_segmenter(config.layers.segmentation)
    first = first_layers(segmenter.segment(pair.previous, pair.colors(pair.previous)))
    labels = segmenter.segment(pair.current, pair.colors(pair.current))
    before = (pair.previous, replace(first, witnesses=witnesses * first.witnesses))
    layers, _ = align_layers(before, pair.current, labels, scale, config.layers)
    corrected = apply_layers(pair.current, layers, config.layers)
    old, new = score(pair, pair.current, scale), score(pair, corrected, scale)
    figures = [
        100 * abs(scale / pair.previous_from_current.scale - 1),
        rotation_error_deg(pair, registration.previous_from_current),
    ]
    for name in ("overlap", "new", "layer_overlap", "layer_new"):
        figures += [getattr(old, name), getattr(new, name)]
    return np.array([*figures, len(layers.scales) / len(labels)])


def read_settings(text: str, assignments: Sequence[str]) -> Config:
    """Read ``NAME_OR_FILE[,section.key=value...]``; ``default`` is no file at all."""
    name, *own = text.split(",")
    path = Path(name)
    file = path if path.suffix in {".yaml", ".yml"} else None
    shipped = None if file or name == "default" else name
    return load_config(shipped, file, [*assignments, *own])


def changed_cases(cases: str, changes: Sequence[str]) -> Iterator[tuple[str, Case]]:
    """List the cases whose name holds the text, each with every combination of the changes.

    Args:
        cases: part of a name; empty: all.
        changes: ``field=value,value...`` of ``Case``, numbers only.

    Raises:
        typer.BadParameter: no case or no such field.
    """
    split = [change.partition("=") for change in changes]
    fields = [name for name, _, _ in split]
    chosen = {name: case for name, case in CASES.items() if cases in name}
    if not chosen:
        raise typer.BadParameter(f"no case '{cases}'; there is: {'; '.join(CASES)}")
    for name in fields:
        if not isinstance(getattr(Case(), name, None), float):
            raise typer.BadParameter(f"a case has no number '{name}'")
    values = [[float(value) for value in text.split(",")] for _, _, text in split]
    for name, case in chosen.items():
        for numbers in itertools.product(*values):
            change: dict[str, Any] = dict(zip(fields, numbers, strict=True))
            label = ", ".join([name, *(f"{key} {value:g}" for key, value in change.items())])
            yield label, replace(case, **change)


def print_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], title: str, *, markdown: bool
) -> None:
    """Print the rows, as Markdown or in columns."""
    if markdown:
        lines = [header, ["---"] * len(header), *rows]
        print(f"{title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines))
        return
    table = Table(*header, title=title)
    for row in rows:
        table.add_row(*row)
    Console(width=None if Console().is_terminal else 220).print(table)


def main(  # noqa: PLR0913, PLR0917  (the options of a command)
    settings: Annotated[
        list[str] | None,
        typer.Option("--config", help="'default', shipped name or file; ',key=value' may follow"),
    ] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", help="setting for all, such as layers.curve=false")
    ] = None,
    cases: Annotated[str, typer.Option(help="only cases whose name holds this text")] = "",
    changes: Annotated[
        list[str] | None,
        typer.Option("--change", help="of the cases, such as unit=0.01,1 or outlier_confidence=0"),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="streets to average over")] = 3,
    witnesses: Annotated[
        float, typer.Option(min=1, help="windows that the first one stands for, see layers.memory")
    ] = TRUTH,
    tall: Annotated[bool, typer.Option("--tall", help="294x518 instead of 154x518")] = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="print Markdown")] = False,
) -> None:
    """Print errors before and after layer-wise scale alignment, mean over the seeds."""
    size = TALL_SIZE if tall else KITTI_SIZE
    try:
        configs = {name: read_settings(name, assignments or []) for name in settings or ["default"]}
        chosen = list(changed_cases(cases, changes or []))
        figures: dict[tuple[str, str], list[Array]] = {
            (label, name): [] for label, _ in chosen for name in configs
        }
        work = list(itertools.product(range(seeds), chosen))
        for seed, (label, case) in track(work, "streets", console=Console(stderr=True)):
            pair = make_pair(case, seed, size)
            for name, config in configs.items():
                figures[label, name].append(measure(pair, config, witnesses))
    except LaserSlamError as error:
        typer.echo(f"ablate_street: {error}", err=True)
        raise typer.Exit(1) from error
    rows = [Row(*key, np.mean(values, axis=0)).cells() for key, values in figures.items()]
    title = f"Before → after, {size[0]}x{size[1]}, mean of {seeds} streets, sky left out"
    print_table(COLUMNS, rows, title, markdown=markdown)


if __name__ == "__main__":
    typer.run(main)
