"""A table as data: its sequences, columns, rows to run and rows that others have published."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from laser_slam.benchmarks.measures import MEASURES
from laser_slam.errors import ConfigError

FOLDER = Path(__file__).parent / "tables"
GENERATED = "synthetic"  # the reader that needs no data


class _Printed(float):
    """A number that knows how it was printed: 9.50 is not 9.5."""

    text: str


class _AsPrinted(yaml.SafeLoader):
    """Reads YAML whose numbers know how they were printed."""


def _read_number(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> _Printed:
    number = _Printed(loader.construct_yaml_float(node))
    number.text = str(node.value)
    return number


_AsPrinted.add_constructor("tag:yaml.org,2002:float", _read_number)


def _as_printed(value: object) -> object:
    if isinstance(value, int | float):
        return getattr(value, "text", str(value))
    return value


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SequenceSpec(_Part):
    """One input of a table.

    Attributes:
        reader: name in ``laser_slam.datasets.DATASETS``, or ``path``: a drive along true poses.
        at: places below the data folder where it may lie, with ``*`` for any part of a name; the
            first that can be read is taken; none: it needs no data.
        prepared: such places that hold the chosen frames alone, to which ``frames`` does not
            apply; they are looked at last.
        arguments: of the reader, after the place.
        frames: first, end and step of the frames that are used, as a slice; none: all.
        num_frames: that there should be; of fewer, what is measured says so; None: not known.
        settings: ``section.key=value`` that this input needs.
        note: what a reader of the table should know of it.
    """

    reader: str
    at: tuple[str, ...] = ()
    prepared: tuple[str, ...] = ()
    arguments: dict[str, Any] = {}
    frames: tuple[int, int | None, int] | None = None
    num_frames: int | None = None
    settings: tuple[str, ...] = ()
    note: str = ""

    @model_validator(mode="after")
    def _lies_somewhere(self) -> Self:
        if self.reader != GENERATED and not self.at:
            raise ValueError(f"the reader {self.reader} needs 'at', the places where data may lie")
        return self


class Column(_Part):
    """One column: the mean of a measure over some sequences, as ``measures.weight`` weighs them.

    Attributes:
        measure: name in ``laser_slam.benchmarks.measures.MEASURES``.
        over: a sequence or a group of them; none: see ``Block.each``.
    """

    name: str
    measure: str
    over: str = ""


class Published(_Part):
    """A row that others have published: for each column a number as printed, a word, or None."""

    method: str
    source: str
    values: tuple[Annotated[str | None, BeforeValidator(_as_printed)], ...]


class Block(_Part):
    """Columns that stand side by side, and what others have published of them.

    Attributes:
        each: sequences that have a line of their own; columns are then over none in particular.
    """

    title: str
    columns: tuple[Column, ...]
    each: tuple[str, ...] = ()
    published: tuple[Published, ...] = ()

    @property
    def all_columns(self) -> tuple[Column, ...]:
        """Return the columns of all lines."""
        if not self.each:
            return self.columns
        return tuple(column for name in self.each for column in self.columns_of(name))

    def columns_of(self, sequence: str) -> tuple[Column, ...]:
        """Return the columns of the line that a sequence has for itself."""
        return tuple(column.model_copy(update={"over": sequence}) for column in self.columns)

    @model_validator(mode="after")
    def _rows_fit(self) -> Self:
        for row in self.published:
            if len(row.values) != len(self.columns):
                raise ValueError(f"{row.method} has {len(row.values)} of {len(self.columns)}")
        for column in self.columns:
            if column.measure not in MEASURES:
                raise ValueError(f"no measure {column.measure}; there is {', '.join(MEASURES)}")
        return self


class Table(_Part):
    """A whole table.

    Attributes:
        title: one line.
        about: what is measured and how, and what to know of the published rows.
        settings: ``section.key=value`` of all its runs, below those of the user.
        rows: what is compared, by name: the settings in which it differs.
        row_groups: names of rows that are run together, by the name of their group.
        sequences: inputs by name.
        groups: names of sequences by the name of their group.
        borrowed: groups of shipped tables, by the table's name, that this one has with all their
            sequences, which stand before its own.
        blocks: of columns.
    """

    title: str
    about: str = ""
    settings: tuple[str, ...] = ()
    rows: dict[str, tuple[str, ...]] = Field(default={"ours": ()}, min_length=1)
    row_groups: dict[str, tuple[str, ...]] = {}
    sequences: dict[str, SequenceSpec]
    groups: dict[str, tuple[str, ...]] = {}
    borrowed: dict[str, tuple[str, ...]] = {}
    blocks: tuple[Block, ...]

    @model_validator(mode="before")
    @classmethod
    def _borrow(cls, raw: Any) -> Any:
        if not isinstance(raw, dict) or not raw.get("borrowed"):
            return raw
        if not isinstance(raw["borrowed"], dict):
            raise ValueError("borrowed: wants a table's name and groups: {kitti: [all]}")
        sequences, groups = {}, {}
        for name, wanted in raw["borrowed"].items():
            other = load_table(name)
            for group in wanted:
                if group not in other.groups:
                    raise ValueError(f"the table {name} has no group {group}")
                groups[group] = other.groups[group]
                sequences.update({each: other.sequences[each] for each in groups[group]})
        own = {key: raw.get(key) or {} for key in ("sequences", "groups")}
        return {
            **raw,
            "sequences": {**sequences, **own["sequences"]},
            "groups": {**groups, **own["groups"]},
        }

    @model_validator(mode="after")
    def _columns_have_sequences(self) -> Self:
        unknown = {name for group in self.groups.values() for name in group}
        unknown -= self.sequences.keys()
        for column in (column for block in self.blocks for column in block.all_columns):
            if column.over not in self.sequences and column.over not in self.groups:
                unknown.add(column.over)
        if unknown:
            raise ValueError(f"no sequences {', '.join(sorted(unknown))}")
        return self

    @model_validator(mode="after")
    def _row_groups_have_rows(self) -> Self:
        for group, names in self.row_groups.items():
            unknown = [name for name in names if name not in self.rows]
            if unknown or group in self.rows:
                raise ValueError(f"row group {group}: no row {', '.join(unknown) or 'itself'}")
        return self

    def members(self, column: Column) -> tuple[str, ...]:
        """Return the names of the sequences that a column is the mean over."""
        return self.groups.get(column.over, (column.over,))

    def measures_of(self, sequence: str) -> set[str]:
        """Return the measures that some column wants of a sequence."""
        columns = (column for block in self.blocks for column in block.all_columns)
        return {column.measure for column in columns if sequence in self.members(column)}


def table_names() -> list[str]:
    """Return the names of all tables."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_table(name: str) -> Table:
    """Read a table by its name, or one of the user's by its path.

    Raises:
        ConfigError: there is no such table, or it is none.
    """
    if name in table_names():
        return parse_table((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        try:
            return parse_table(path.read_text(encoding="utf-8"), name)
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"cannot read the table {name}: {error}") from error
    near = difflib.get_close_matches(name, table_names(), n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise ConfigError(
        f"no table '{name}'{hint}; there is {', '.join(table_names())}, or give the path of a "
        "YAML file of your own"
    )


def parse_table(text: str, name: str = "table") -> Table:
    """Read a table from YAML.

    Args:
        text: YAML.
        name: of the file, for the error.

    Raises:
        ConfigError: it is no table.
    """
    try:
        return Table.model_validate(yaml.load(text, _AsPrinted))
    except yaml.YAMLError as error:
        raise ConfigError(f"{name} is no YAML: {' '.join(str(error).split())}") from error
    except ValidationError as error:
        raise ConfigError(f"{name}: {_explain(error)}") from error


def _explain(error: ValidationError) -> str:
    """Name the first things that are wrong, and where."""
    parts = []
    for item in error.errors()[:3]:
        place = ".".join(str(part) for part in item["loc"])
        parts.append(f"{place}: {item['msg']}" if place else str(item["msg"]))
    return "; ".join(parts).replace("Value error, ", "")
