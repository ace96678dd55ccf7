"""Tables of texts, for the terminal and for Markdown pages."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, without a line break at its end.

    Example:
        >>> print(markdown_table(["metric", "value"], [["SAM, rad", "0.046"]]))
        | metric | value |
        | --- | --- |
        | SAM, rad | 0.046 |
    """
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows))


def screen_table(header: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> Table:
    """A table for a `rich` console."""
    table = Table(*header, title=title)
    for row in rows:
        table.add_row(*row)
    return table
