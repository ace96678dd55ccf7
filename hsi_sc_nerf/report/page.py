"""The report as one HTML file: sections in, text out."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from hsi_sc_nerf.report.blocks import KeyFigure, Section

_PACKAGE = "hsi_sc_nerf.report"
_SCRIPTS = ("cloud_data.js", "cloud_renderer.js", "cloud_controls.js")


def html_page(title: str, subtitle: str, key_figures: Sequence[KeyFigure], sections: Sequence[Section]) -> str:
    """The page, with style sheet and scripts in it; every text is escaped.

    Args:
        title: heading.
        subtitle: a line below it.
        key_figures: numbers to begin with.
        sections: in their order.
    """
    environment = Environment(
        loader=PackageLoader(_PACKAGE), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("page.html").render(
        title=title,
        subtitle=subtitle,
        key_figures=key_figures,
        sections=sections,
        styles=_own_text("page.css"),
        scripts=Markup("\n").join(map(_own_text, _SCRIPTS)),
        footer="Made by hsi-sc-nerf report. This file is complete: it needs no network and no other file.",
    )


def _own_text(name: str) -> Markup:
    """A file of this package, which goes into the page as it is."""
    return Markup((files(_PACKAGE) / "templates" / name).read_text(encoding="utf-8"))
