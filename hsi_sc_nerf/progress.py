"""Progress of an export on the terminal, with the time left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def progress_bar(title: str, unit: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar up to ``total``; what it yields is called with how much is done."""
    with Progress(
        TextColumn(f"[bold]{title}"),
        BarColumn(),
        TextColumn(f"{{task.completed:,.0f}} of {{task.total:,.0f}} {unit}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as progress:
        task = progress.add_task("", total=total)

        def done(amount: int) -> None:
            progress.update(task, completed=min(amount, total))

        yield done
