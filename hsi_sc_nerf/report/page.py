"""What a section of the report is made of, and the page as one HTML file; the template escapes every text."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import UInt8
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from PIL import Image, UnidentifiedImageError

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.findings import Finding

_PACKAGE = "hsi_sc_nerf.report"
_PARTS = ("data", "renderer", "chart", "regions", "picture", "gestures", "controls")
_SCRIPTS = tuple(f"cloud_{part}.js" for part in _PARTS)
WIDEST_PX = 1600
"""Wider pictures are downscaled to this."""
_QUALITY = 82
_AGAIN = "make it again"
# Levels of findings as words, because colour alone does not tell everybody.
_WORDS = {"green": "Good:", "amber": "Check:", "red": "Problem:"}
_MOST_GOOD = 3
"""More good findings of a section are folded."""
_LONG_CELL = 24
"""Characters from which a cell may be broken into lines."""


@dataclass(frozen=True)
class Missing:
    """A missing result, and the command that makes it."""

    kind: ClassVar[str] = "missing"
    text: str
    command: str


@dataclass(frozen=True)
class Table:
    """Rows of texts; the first column names the row."""

    kind: ClassVar[str] = "table"
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def stacks(self) -> bool:
        """Whether it is too wide for a phone, which shows each row as a list."""
        long = any(len(cell) > _LONG_CELL for row in self.rows for cell in row[1:])
        return len(self.header) > (2 if long else 3)


@dataclass(frozen=True)
class Figure:
    """Pictures or charts with a caption that states their units."""

    kind: ClassVar[str] = "figure"
    pictures: Mapping[str, Markup]
    """By their titles; a single one has an empty title."""
    caption: str
    columns: int = 1
    """Number of pictures side by side on a wide screen."""


@dataclass(frozen=True)
class Folded:
    """Details that a click opens."""

    kind: ClassVar[str] = "folded"
    summary: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class CloudViewer:
    """The object in 3D."""

    kind: ClassVar[str] = "cloud"
    payload: dict[str, Any]
    caption: str


Block = str | Missing | Table | Figure | Folded | CloudViewer
"""What a section is made of; a text is a paragraph."""


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes:
        anchor: its name in links.
        title: its heading.
        blocks: what is in it.
        findings: what is good and what to look at, shown first.
    """

    anchor: str
    title: str
    blocks: Sequence[Block]
    findings: Sequence[Finding] = ()


def read_known(path: Path) -> dict[str, Any] | None:
    """Content of a JSON file; None if it does not exist.

    Raises:
        InputError: it is not a JSON object.
    """
    return read_json(path, _AGAIN) if path.is_file() else None


def html_page(title: str, subtitle: str, key_figures: Mapping[str, str], sections: Sequence[Section]) -> str:
    """The page, with style sheet and scripts in it; every text is escaped.

    Args:
        title: heading.
        subtitle: a line below it.
        key_figures: numbers with their units to begin with, by name.
        sections: in their order.
    """
    return page_template(_PACKAGE, "page.html").render(
        title=title,
        subtitle=subtitle,
        key_figures=key_figures,
        sections=sections,
        words=_WORDS,
        most_good=_MOST_GOOD,
        long_cell=_LONG_CELL,
        styles=own_text(_PACKAGE, "page.css"),
        scripts=Markup("\n").join(own_text(_PACKAGE, name) for name in _SCRIPTS),
        footer="Made by hsi-sc-nerf report. This file is complete: it needs no network and no other file.",
    )


def page_template(package: str, name: str) -> Template:
    """A template of a package, which escapes every text and may extend ``layout.html``."""
    loader = ChoiceLoader([PackageLoader(package), PackageLoader(_PACKAGE)])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.get_template(name)


def own_text(package: str, name: str) -> Markup:
    """A file among a package's templates, which is not escaped."""
    return Markup((files(package) / "templates" / name).read_text(encoding="utf-8"))


def embedded_array(image: UInt8[np.ndarray, "h w 3"], alt: str) -> Markup:
    """An ``img`` of an array, lossless; the page shows its pixels as squares."""
    return _img(Image.fromarray(np.ascontiguousarray(image)), alt, lossless=True, css_class="pixels")


def embedded_file(path: Path, alt: str) -> Markup:
    """An ``img`` of a picture file, downscaled if it is large.

    Raises:
        InputError: the file is not a readable picture.
    """
    try:
        with Image.open(path) as opened:
            image = opened.convert("RGB")
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is not a readable picture ({error}); delete it, or make it again.") from error
    if image.width > WIDEST_PX:
        image = image.resize((WIDEST_PX, round(image.height * WIDEST_PX / image.width)), Image.Resampling.LANCZOS)
    return _img(image, alt, lossless=False, css_class="picture")


def _img(image: Image.Image, alt: str, lossless: bool, css_class: str) -> Markup:
    tag = Markup('<img class="{}" alt="{}" width="{}" height="{}" src="{}">')
    return tag.format(css_class, alt, image.width, image.height, data_address(image, lossless))


def data_address(image: Image.Image, lossless: bool = False, quality: int = _QUALITY) -> str:
    """Address that is the picture itself."""
    memory = io.BytesIO()
    image.save(memory, "WEBP", lossless=lossless, quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(memory.getvalue()).decode()}"
