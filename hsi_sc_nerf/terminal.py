"""What is shown on the terminal: tables, progress bars, and none of the libraries' warnings about each other."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

# Category, module that warns, start of the message; both are regular expressions.
_KNOWN: tuple[tuple[type[Warning], str, str], ...] = (
    (FutureWarning, r"nerfstudio\.", r"`torch\.cuda\.amp\."),
    (FutureWarning, r"torch\.jit", r"`torch\.jit\.script` is deprecated"),
    (UserWarning, r"nerfstudio\.cameras\.cameras", r"Using a non-tuple sequence for multidimensional indexing"),
    (UserWarning, r"nerfstudio\.utils\.writer", r"Converting a tensor with requires_grad=True to a scalar"),
    (UserWarning, r"nerfstudio\.pipelines\.base_pipeline", r"std_mean\(\): degrees of freedom is <= 0"),
    (UserWarning, r"tyro\.", r"The field `pipeline\._target` is annotated with type"),
    (UserWarning, r"torchmetrics\.|lightning_utilities\.", r"pkg_resources is deprecated"),
)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, without a line break at its end.

    Example:
        >>> print(markdown_table(["metric", "value"], [["SAM, rad", "0.046"]]))
        | metric | value |
        | --- | --- |
        | SAM, rad | 0.046 |
    """
    lines = (map(markdown_text, line) for line in (header, ["---"] * len(header), *rows))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def markdown_text(text: str) -> str:
    """A text on one line, such as a name from a file, that makes no cells, links or HTML in a Markdown page.

    Example:
        >>> print(markdown_text("a|b<c>"))
        a\\|b&lt;c>
    """
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


def screen_table(header: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> Table:
    """A table for a `rich` console."""
    table = Table(*header, title=title)
    for row in rows:
        table.add_row(*row)
    return table


def timed_progress(*columns: ProgressColumn) -> Progress:
    """rich's progress with description, bar, the given columns, elapsed time and time left, on standard error."""
    return Progress(
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        *columns,
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


@contextmanager
def progress_bar(title: str, unit: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar up to ``total``; the context gives a function that takes the amount done so far.

    Example:
        >>> with progress_bar("rendering", "views", total=60) as update:
        ...     for i in range(60):
        ...         update(i + 1)
    """
    with timed_progress(TextColumn(f"{{task.completed:,.0f}} of {{task.total:,.0f}} {unit}")) as progress:
        task = progress.add_task(title, total=total)
        yield lambda amount: progress.update(task, completed=min(amount, total))


def ignore_library_warnings() -> None:
    """Ignore the libraries' warnings that a user can do nothing about, and no others, from here on."""
    for category, module, message in _KNOWN:
        warnings.filterwarnings("ignore", message=message, category=category, module=module)
