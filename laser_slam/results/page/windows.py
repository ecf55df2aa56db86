"""The page's view of the windows: scales, registrations, layers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from laser_slam.report.html import Block, Charts, Fold, Pictures, Section, Table, Text
from laser_slam.report.html_charts import Axis, Chart, Line, Role, line_chart
from laser_slam.results.page.paths import find_picture
from laser_slam.results.page.reading import (
    Report,
    column,
    count,
    look,
    number,
    percent,
    plain,
    records,
    say,
)

_MAX_ROWS = 500  # of the table of windows

Array = NDArray[np.float64]


def windows(report: Report, folder: Path) -> Section:
    """Show how windows were registered, how their scale drifts, and what layers did."""
    charts = [
        chart
        for chart in (_scales(report), _share(report), _residuals(report), *_layer_charts(report))
        if chart is not None
    ]
    blocks: list[Block] = [Charts(charts, 2)] if charts else []
    if not records(report, "windows.records"):  # a report of an older version
        drawn = [
            find_picture(folder, name, title, title)
            for name, title in (
                ("scales", "Scale of the windows over the distance"),
                ("layer_mismatch", "Depth of shared frames: difference to the window before"),
            )
        ]
        blocks += [Pictures([p for p in drawn if p is not None], "two")] if any(drawn) else []
    if look(report, "layers"):
        blocks.append(Text(_layers_in_words(report)))
    rows = records(report, "windows.records")
    if rows:
        title = f"All {len(rows)} windows" if len(rows) <= _MAX_ROWS else "Windows"
        blocks.append(Fold(title, [_table(report)]))
    bridged = look(report, "windows.bridged")
    if bridged:
        table = [[str(window), str(reason)] for window, reason in bridged.items()]
        caption = "Bridged windows: their place is the motion of the window before, gone on with"
        blocks.insert(0, Table(caption, ["window", "why"], table, frozenset({1})))
    return Section("windows", "Windows", blocks)


def _scales(report: Report) -> Chart | None:
    rows = _placed(report)
    unit = str(look(report, "windows.unit") or "world units")
    names: tuple[tuple[str, str, Role], ...] = (
        ("true_scale", "truth", "truth"),
        ("scale_without_loops", "without loops", "without"),
        ("scale", "estimate", "estimate"),
    )
    lines = _lines(rows, "distance", names)
    if not lines:
        return None
    ends = " to ".join(say(float(value)) for value in (lines[-1].y[0], lines[-1].y[-1]))
    title = "Scale of the windows over the distance"
    alt = f"{title}, {len(rows)} windows; from the first to the last {ends} {unit} per window unit."
    x_axis, y_axis = Axis(f"distance travelled ({unit})"), Axis(f"{unit} per window unit")
    return line_chart(title, alt, lines, x_axis, y_axis)


def _share(report: Report) -> Chart | None:
    """Draw how far the scale of each window is off the true one."""
    rows, true = _placed(report), column(_placed(report), "true_scale")
    if not np.isfinite(true).any():
        return None
    x = column(rows, "distance")
    names: tuple[tuple[str, str, Role], ...] = (
        ("scale_without_loops", "without loops", "without"),
        ("scale", "estimate", "estimate"),
    )
    lines = [
        Line(label, role, x, column(rows, name) / true, is_marked=True)
        for name, label, role in names
        if np.isfinite(column(rows, name)).any()
    ]
    off = np.abs(lines[-1].y - 1)
    title = "Share of the true scale"
    alt = (
        f"{title}: the estimate is off by {percent(float(np.nanmedian(off)), 2)} in the median, "
        f"by {percent(float(np.nanmax(off)), 2)} at most."
    )
    line = Line("truth", "truth", x, np.ones(len(x)))
    x_axis = Axis(f"distance travelled ({look(report, 'windows.unit')})")
    return line_chart(title, alt, [line, *lines], x_axis, Axis("found / true", is_percent=True))


def _residuals(report: Report) -> Chart | None:
    rows = records(report, "windows.records")
    names: tuple[tuple[str, str, Role], ...] = (
        ("registration.scale_sigma_percent", "1 sigma of the scale", "without"),
        ("registration.residual", "median difference of depths", "estimate"),
    )
    x = column(rows, "window")
    residual, sigma = column(rows, names[1][0]), column(rows, names[0][0]) / 100
    if not np.isfinite(residual).any():
        return None
    lines = [
        Line(names[0][1], names[0][2], x, sigma),
        Line(names[1][1], names[1][2], x, residual, is_marked=True),
    ]
    title = "Registration to the window before"
    alt = (
        f"{title}: depths of shared pixels differ by "
        f"{percent(float(np.nanmedian(residual)), 2)} in the median window, by "
        f"{percent(float(np.nanmax(residual)), 2)} in the worst."
    )
    y_axis = Axis("share of the depth", is_percent=True, has_zero=True)
    return line_chart(title, alt, lines, Axis("window", is_whole=True), y_axis)


def _layer_charts(report: Report) -> list[Chart]:
    """Draw what layer-wise scale alignment did in each window."""
    found = look(report, "layers.windows") or {}
    x, rows = np.array([float(index) for index in found]), list(found.values())
    before, after = column(rows, "mismatch_before"), column(rows, "mismatch_after")
    out = []
    if np.isfinite(before).any():
        title = "Depth of shared frames against the window before"
        medians = [percent(float(np.nanmedian(values)), 2) for values in (before, after)]
        alt = f"{title}: {medians[0]} apart after registration, {medians[1]} with layer scales."
        lines = [
            Line("after registration", "without", x, before, is_marked=True),
            Line("with layer scales, first pass", "estimate", x, after, is_marked=True),
        ]
        y_axis = Axis("median difference", is_percent=True, has_zero=True)
        out.append(line_chart(title, alt, lines, Axis("window", is_whole=True), y_axis))
    low, middle, high = (column(rows, f"scales.{name}") for name in ("p5", "p50", "p95"))
    if np.isfinite(middle).any():
        title = "Scales of the layers, by area"
        span = f"{say(float(np.nanmin(low)))} to {say(float(np.nanmax(high)))}"
        alt = f"{title}: 5 % and 95 % of the area lie within {span} over all windows."
        lines = [
            Line("5 % and 95 %", "band", x, low),
            Line("", "band", x, high),
            Line("median", "estimate", x, middle, is_marked=True),
        ]
        out.append(
            line_chart(
                title, alt, lines, Axis("window", is_whole=True), Axis("factor on the depth")
            )
        )
    return out


def _layers_in_words(report: Report) -> str:
    reached, layers = number(report, "layers.reached"), number(report, "layers.layers")
    share = percent(reached / layers, 2) if reached is not None and layers else ""
    return (
        f"Layer-wise scale alignment: {count(layers)} layers, {count(reached)} of them ({share}) "
        f"reached by a scale; {count(number(report, 'layers.linked'))} links between windows, "
        f"{count(number(report, 'layers.refused'))} not trusted."
    )


def _table(report: Report) -> Table:
    rows = records(report, "windows.records")
    shown = rows[:_MAX_ROWS]
    caption = (
        f"The first {_MAX_ROWS} of {len(rows)} windows" if len(shown) < len(rows) else "Windows"
    )
    head = ["window", "frames", "scale to the one before", "1 sigma", "residual", "pixels"]
    unit = look(report, "windows.unit") or "world units"
    return Table(
        caption,
        [*head, f"{unit} per window unit", "before closures", "true"],
        [
            [
                plain(look(row, "window")),
                f"{plain(look(row, 'first_frame'))} to {plain(look(row, 'last_frame'))}",
                say(number(row, "registration.scale"), 4),
                f"{say(number(row, 'registration.scale_sigma_percent'), 2)} %".lstrip(" %"),
                percent(number(row, "registration.residual"), 2),
                count(number(row, "registration.num_pixels")),
                *(
                    say(number(row, name), 4)
                    for name in ("scale", "scale_without_loops", "true_scale")
                ),
            ]
            for row in shown
        ],
    )


def _placed(report: Report) -> list[Report]:
    return [row for row in records(report, "windows.records") if number(row, "scale") is not None]


def _lines(rows: Sequence[Report], x: str, names: Sequence[tuple[str, str, Role]]) -> list[Line]:
    return [
        Line(label, role, column(rows, x), column(rows, name), is_marked=role == "estimate")
        for name, label, role in names
        if np.isfinite(column(rows, name)).any()
    ]
