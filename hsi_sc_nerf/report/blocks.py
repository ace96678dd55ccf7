"""What a section of the report is made of; the page's template turns it into HTML and escapes every text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from markupsafe import Markup


@dataclass(frozen=True)
class Paragraph:
    """A sentence or two."""

    kind: ClassVar[str] = "paragraph"
    text: str


@dataclass(frozen=True)
class Missing:
    """What there is not, and what to run to get it."""

    kind: ClassVar[str] = "missing"
    text: str
    command: str


@dataclass(frozen=True)
class Warnings:
    """What to be wary of, a sentence each."""

    kind: ClassVar[str] = "warnings"
    sentences: Sequence[str]


@dataclass(frozen=True)
class Table:
    """Rows of texts; the first column names the row."""

    kind: ClassVar[str] = "table"
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Figure:
    """Pictures or charts with a caption that tells their units."""

    kind: ClassVar[str] = "figure"
    pictures: Sequence[Markup]
    caption: str
    titles: Sequence[str] = ()
    """Of each picture, where they have any."""
    columns: int = 1
    """How many stand side by side on a wide screen."""


@dataclass(frozen=True)
class Folded:
    """What only some readers want to see, opened by a click."""

    kind: ClassVar[str] = "folded"
    summary: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class CloudViewer:
    """The object in 3D."""

    kind: ClassVar[str] = "cloud"
    payload: dict[str, Any]
    caption: str


Block = Paragraph | Missing | Warnings | Table | Figure | Folded | CloudViewer


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes:
        anchor: its name in links.
        title: its heading.
        blocks: what is in it.
    """

    anchor: str
    title: str
    blocks: Sequence[Block] = field(default_factory=tuple)


@dataclass(frozen=True)
class KeyFigure:
    """A number at the head of the page, with its unit in the text."""

    value: str
    name: str
