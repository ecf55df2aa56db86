"""Reading a report that may be older than this page, and saying its numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Report = Mapping[str, Any]

_KIB = 1024


def look(report: Any, name: str) -> Any:
    """Return what stands under ``a.b.c``; None where any of these is missing.

    >>> look({"depth": None, "map": {"num_points": 3}}, "map.num_points")
    3
    >>> look({"depth": None}, "depth.abs_rel") is None
    True
    """
    for key in name.split("."):
        report = report.get(key) if isinstance(report, Mapping) else None
    return report


def number(report: Any, name: str) -> float | None:
    """Return the number that stands under ``a.b.c``; None where there is none."""
    value = look(report, name)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(value) else None


def records(report: Any, name: str) -> list[Report]:
    """Return the list of records under ``a.b.c``; empty where there is none."""
    found = look(report, name)
    is_list = isinstance(found, Sequence) and not isinstance(found, str)
    return [item for item in found if isinstance(item, Mapping)] if is_list else []


def column(rows: Sequence[Any], name: str) -> NDArray[np.float64]:
    """Return the (N,) numbers under ``a.b.c`` of each row; NaN where there is none."""
    values = [number(row, name) for row in rows]
    return np.array([math.nan if value is None else value for value in values], np.float64)


def series(report: Any, name: str) -> NDArray[np.float64]:
    """Return the list of numbers under ``a.b.c``; NaN for null, empty where there is none."""
    found = look(report, name)
    return np.array([math.nan if value is None else value for value in found or []], np.float64)


def flatten(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """List nested values as ``a.b.c`` and value.

    >>> list(flatten({"a": {"b": 1, "c": [2, 3]}}))
    [('a.b', 1), ('a.c', [2, 3])]
    """
    if not isinstance(value, Mapping):
        yield prefix, value
        return
    for key, inner in value.items():
        yield from flatten(inner, f"{prefix}.{key}" if prefix else str(key))


def say(value: float | None, digits: int = 3, *, factor: float = 1.0) -> str:
    """Write a number with so many digits that mean something; empty where there is none.

    >>> say(0.41548), say(26.216), say(1234567.0), say(None), say(0.0234, factor=100)
    ('0.415', '26.2', '1,234,567', '', '2.34')
    """
    if value is None or not math.isfinite(value):
        return ""
    value *= factor
    power = math.floor(math.log10(abs(value))) if value else 0
    if power < -4:
        return f"{value:.{digits - 1}e}"
    return f"{value:,.{max(0, digits - 1 - power)}f}"


def percent(value: float | None, digits: int = 3) -> str:
    """Write a share as percent; empty where there is none."""
    return f"{say(value, digits, factor=100)} %" if value is not None else ""


def count(value: float | None) -> str:
    """Write a whole number.

    >>> count(4378311), count(None)
    ('4,378,311', '')
    """
    return "" if value is None else f"{value:,.0f}"


def file_size(num_bytes: float) -> str:
    """Write the size of a file.

    >>> file_size(999), file_size(83188138)
    ('999 B', '79.3 MiB')
    """
    for unit in ("B", "KiB", "MiB", "GiB"):
        if num_bytes < _KIB or unit == "GiB":
            break
        num_bytes /= _KIB
    return f"{num_bytes:.0f} B" if unit == "B" else f"{say(num_bytes)} {unit}"


def plain(value: Any) -> str:
    """Write any value of a report or of the settings in one line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(plain(item) for item in value) or "none"
    return str(value)
