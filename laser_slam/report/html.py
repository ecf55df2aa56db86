"""The page of a run: what it can hold, and how it becomes one file of HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import ClassVar, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined

from laser_slam.report.html_charts import Chart
from laser_slam.report.html_pictures import Embedded


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    text: str


@dataclass(frozen=True)
class Number:
    """One number that a reader looks for first.

    Attributes:
        label: its name.
        value: with as many digits as mean something; empty: unknown, and the note says why.
        unit: of the value.
        note: what it was measured over, or why there is none.
    """

    label: str
    value: str
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Numbers:
    """Numbers side by side."""

    kind: ClassVar[str] = "numbers"
    numbers: Sequence[Number]


@dataclass(frozen=True)
class Table:
    """Rows of texts below column heads; the first cell names its row.

    Attributes:
        caption: what it shows.
        head: of the columns.
        rows: as many texts each; empty: unknown.
        wordy: columns of words, set flush left; the others hold numbers.
        links: address of each row's first cell, by row; relative to the page.
    """

    kind: ClassVar[str] = "table"
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    wordy: frozenset[int] = frozenset()
    links: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Picture:
    """An embedded picture with what it shows.

    Attributes:
        image: as it stands in the page.
        title: of the figure.
        alt: what is to be seen, in words and numbers.
    """

    image: Embedded
    title: str
    alt: str


@dataclass(frozen=True)
class Pictures:
    """Pictures below each other, or side by side where the page is wide.

    Attributes:
        pictures: in this order.
        layout: of a wide page: ``one`` below the other, ``two`` in a row, or the first as
            ``lead``, the others smaller beside it.
    """

    kind: ClassVar[str] = "pictures"
    pictures: Sequence[Picture]
    layout: Literal["one", "two", "lead"] = "one"


@dataclass(frozen=True)
class Charts:
    """Charts below each other, or side by side where the page is wide."""

    kind: ClassVar[str] = "charts"
    charts: Sequence[Chart]
    columns: int = 1


@dataclass(frozen=True)
class Bar:
    """A stage's share.

    Attributes:
        label: its name.
        share: of the longest bar, in [0, 1].
        texts: numbers beside the bar.
    """

    label: str
    share: float
    texts: Sequence[str]


@dataclass(frozen=True)
class Bars:
    """Bars from the left, as a table.

    Attributes:
        caption: what they show.
        head: of label, bar and texts.
        bars: in this order.
    """

    kind: ClassVar[str] = "bars"
    caption: str
    head: Sequence[str]
    bars: Sequence[Bar]


@dataclass(frozen=True)
class Pair:
    """Two images that may show one place.

    Attributes:
        images: the earlier visit first.
        alts: of the images.
        is_accepted: whether the loop was closed.
        title: in short.
        text: what was measured.
    """

    images: tuple[Embedded, Embedded]
    alts: tuple[str, str]
    is_accepted: bool
    title: str
    text: str


@dataclass(frozen=True)
class Pairs:
    """Pairs of images in a grid."""

    kind: ClassVar[str] = "pairs"
    pairs: Sequence[Pair]


@dataclass(frozen=True)
class Notes:
    """A list of messages, such as warnings."""

    kind: ClassVar[str] = "notes"
    notes: Sequence[str]


@dataclass(frozen=True)
class Fold:
    """Blocks that show once a reader opens them."""

    kind: ClassVar[str] = "fold"
    summary: str
    blocks: Sequence[Block]


Block = Text | Numbers | Table | Pictures | Charts | Bars | Pairs | Notes | Fold


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading.

    Attributes:
        key: names it in the page's address; letters only.
        title: of the heading.
        blocks: in this order; none: the section is left out.
    """

    key: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Page:
    """Everything that the page of a run shows.

    Attributes:
        title: the sequence's name.
        facts: a few words each on what was run, below the title.
        headline: the numbers that matter most.
        warnings: of the run.
        sections: in this order.
        footer: who made the page.
    """

    title: str
    facts: Sequence[str]
    headline: Numbers
    warnings: Sequence[str]
    sections: Sequence[Section]
    footer: str


def render_page(page: Page) -> str:
    """Return the page as one HTML file: no scripts, nothing from the network, all text escaped."""
    return _environment().get_template("page.html.j2").render(page=page)


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("laser_slam.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
