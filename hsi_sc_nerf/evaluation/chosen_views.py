"""Which of the held-out views are looked at where not all are, by the benchmark and the report alike."""

from __future__ import annotations


def spread_of_views(count: int, number: int) -> list[int]:
    """Indices of ``number`` of ``count`` views, evenly spread from the first one; at most all.

    Example:
        >>> spread_of_views(6, 3)
        [0, 2, 4]
    """
    number = min(count, number)
    return [i * count // number for i in range(number)]
