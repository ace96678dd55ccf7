"""Tables of figures in the pages that tell them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hsi_sc_nerf.tables import markdown_table


def write_table(
    page: Path, name: str, columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str | None = None
) -> None:
    """Put a table, and a line below it, between a page's two marks ``<!-- NAME -->`` and ``<!-- end of NAME -->``."""
    starts, ends = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, rest = page.read_text(encoding="utf-8").split(starts)
    after = rest.split(ends)[1]
    lines = [markdown_table(columns, rows)]
    if caption is not None:
        lines += ["", caption]
    page.write_text("\n".join([before + starts, *lines, ends + after]), encoding="utf-8")
