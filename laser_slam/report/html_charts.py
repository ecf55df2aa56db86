"""Line charts as vector graphics that take the colours of the page and any width."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]
Role = Literal["truth", "without", "estimate", "accepted", "rejected", "band", "start", "end"]

BOX = 1000  # units of the drawing, on both sides; the page stretches them
_WIDE, _TALL = 2.4, 0.8  # limits of a plan's width over its height
_MARGIN = 0.05  # around a plan, in extents
_ASPECT = 2.6  # width over height of a chart that is no plan
_LEAST = 1e-12
_DECIMALS = 7


@dataclass(frozen=True)
class Line:
    """Points joined in their order; where one is not finite, the line has a gap.

    Attributes:
        label: for the legend; empty: none.
        role: decides colour and dashes.
        x: (N,) any order.
        y: (N,) in the unit of the axis.
        is_marked: whether the points get dots.
        is_joined: whether lines run between them.
    """

    label: str
    role: Role
    x: Array
    y: Array
    is_marked: bool = False
    is_joined: bool = True


@dataclass(frozen=True)
class Axis:
    """An axis of a chart.

    Attributes:
        label: with the unit.
        is_percent: whether values are shares, shown as percent.
        has_zero: whether zero must be in view.
        is_whole: whether only whole numbers mean something.
    """

    label: str
    is_percent: bool = False
    has_zero: bool = False
    is_whole: bool = False


@dataclass(frozen=True)
class Stroke:
    """A line as it is drawn: SVG path data in a square of 1000 units, y downwards."""

    label: str
    role: Role
    path: str
    dots: str


@dataclass(frozen=True)
class Tick:
    """A mark of an axis: its place in percent from the left or the top, and its text."""

    percent: float
    text: str


@dataclass(frozen=True)
class Chart:
    """A chart that is ready to be drawn.

    Attributes:
        title: of the figure.
        alt: what is to be seen, in words and numbers.
        strokes: in the order of drawing.
        x_ticks: from the left.
        y_ticks: from the top.
        x_label: with the unit.
        y_label: with the unit.
        aspect: width over height.
        is_plan: whether both axes have one unit and one scale.
    """

    title: str
    alt: str
    strokes: Sequence[Stroke]
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]
    x_label: str
    y_label: str
    aspect: float
    is_plan: bool = False

    @property
    def gutter(self) -> int:
        """Return how many letters the longest text at the left has."""
        return max((len(tick.text) for tick in self.y_ticks), default=1)


def line_chart(title: str, alt: str, lines: Sequence[Line], x_axis: Axis, y_axis: Axis) -> Chart:
    """Draw lines over a common x axis.

    Args:
        title: of the figure.
        alt: what is to be seen, in words and numbers.
        lines: in the order of drawing.
        x_axis: whose limits are those of the lines.
        y_axis: with some room above and below.
    """
    x_limits = _limits([line.x for line in lines], x_axis.has_zero)
    low, high = _limits([line.y for line in lines], y_axis.has_zero)
    room = 0.06 * (high - low)
    y_limits = (low if y_axis.has_zero and low >= 0 else low - room, high + room)
    return _chart(title, alt, lines, (x_axis, y_axis), (x_limits, y_limits), _ASPECT)


def plan_chart(title: str, alt: str, lines: Sequence[Line], unit: str) -> Chart:
    """Draw paths from above with equal axes: x to the right, z forward.

    Args:
        title: of the figure.
        alt: what is to be seen, in words and numbers.
        lines: in the order of drawing.
        unit: of both axes.
    """
    limits = [_limits([line.x for line in lines]), _limits([line.y for line in lines])]
    middle = np.array([(low + high) / 2 for low, high in limits])
    size = np.array([high - low for low, high in limits])
    size += 2 * _MARGIN * size.max()
    aspect = float(np.clip(size[0] / size[1], _TALL, _WIDE))
    size = np.maximum(size, [size[1] * aspect, size[0] / aspect])
    (left, bottom), (right, top) = middle - size / 2, middle + size / 2
    axes = Axis(f"x, right ({unit})"), Axis(f"z, forward ({unit})")
    chart = _chart(title, alt, lines, axes, ((left, right), (bottom, top)), aspect)
    return replace(chart, is_plan=True)


def _chart(
    title: str,
    alt: str,
    lines: Sequence[Line],
    axes: tuple[Axis, Axis],
    limits: tuple[tuple[float, float], tuple[float, float]],
    aspect: float,
) -> Chart:
    x_ticks, y_ticks = (
        list(_ticks(axis, limit, num))
        for axis, limit, num in zip(axes, limits, (6, 5), strict=True)
    )
    return Chart(
        title,
        alt,
        [_stroke(line, limits) for line in lines],
        x_ticks,
        [Tick(round(100 - tick.percent, 2), tick.text) for tick in y_ticks],
        axes[0].label,
        axes[1].label,
        round(aspect, 4),
    )


def _limits(values: Sequence[Array], has_zero: bool = False) -> tuple[float, float]:
    """Return what all finite values lie within; never an empty range."""
    known = np.concatenate([np.zeros(int(has_zero)), *values])
    known = known[np.isfinite(known)]
    if not len(known):
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    if high - low > max(_LEAST, 1e-9 * max(abs(low), abs(high))):
        return low, high
    half = 0.1 * abs(low) or 0.5
    return (low, low + 2 * half) if has_zero else (low - half, low + half)


def _ticks(axis: Axis, limits: tuple[float, float], num: int) -> Iterator[Tick]:
    low, high = limits
    steps = [1, 2, 5, 10] if axis.is_whole else [1, 2, 2.5, 5, 10]
    locator = MaxNLocator(nbins=num, steps=steps, integer=axis.is_whole)
    values = locator.tick_values(low, high)
    step = float(values[1] - values[0]) if len(values) > 1 else 1.0
    for value in values:
        if low - 1e-9 * (high - low) <= value <= high + 1e-9 * (high - low):
            percent = round(100 * float(value - low) / (high - low), 2)
            yield Tick(percent, _tick_text(float(value), step, is_percent=axis.is_percent))


def _tick_text(value: float, step: float, *, is_percent: bool) -> str:
    """Write a round number with the decimals that the step asks for.

    >>> _tick_text(0.25, 0.05, is_percent=False), _tick_text(-1500.0, 500, is_percent=False)
    ('0.25', '−1,500')
    >>> _tick_text(0.025, 0.025, is_percent=True), _tick_text(-1e-17, 1, is_percent=False)
    ('2.5 %', '0')
    """
    if is_percent:
        value, step = 100 * value, 100 * step
    decimals = next((d for d in range(_DECIMALS) if round(step, d) > 0.999 * step), None)
    if decimals is not None and abs(round(step, decimals) - step) > 1e-6 * step:
        decimals += 1  # 2.5, 0.25, ...
    text = f"{value:.3g}" if decimals is None else f"{round(value, decimals) + 0.0:,.{decimals}f}"
    return text.replace("-", "−") + (" %" if is_percent else "")


def _stroke(line: Line, limits: tuple[tuple[float, float], tuple[float, float]]) -> Stroke:
    (left, right), (bottom, top) = limits
    x = BOX * (line.x - left) / (right - left)
    y = BOX * (top - line.y) / (top - bottom)
    places = [
        (f"{a:.1f} {b:.1f}" if np.isfinite(a) and np.isfinite(b) else "")
        for a, b in zip(x.tolist(), y.tolist(), strict=True)
    ]
    path = "".join(_joined(places)) if line.is_joined else ""
    # A line of no length with round ends is a dot that no stretching turns into an ellipse.
    dots = "".join(f"M{place}h0" for place in places if place) if line.is_marked else ""
    return Stroke(line.label, line.role, path, dots)


def _joined(places: Sequence[str]) -> Iterator[str]:
    is_open = False
    for place in places:
        if place:
            yield ("L" if is_open else "M") + place
        is_open = bool(place)
