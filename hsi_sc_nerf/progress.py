"""Progress bars on the terminal, with the time left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn


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
