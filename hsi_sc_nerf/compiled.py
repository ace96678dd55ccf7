"""Functions that numba compiles for the processor, once for all processes where a folder can be written to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Decorator of a function that releases the interpreter's lock and divides as NumPy does.

    What was compiled is kept beside the sources or in the home folder. Where neither can be written to, as in a
    read-only container, each process compiles it anew.

    Args:
        function: what is decorated, where the decorator has no options.
        options: further ones of ``numba.njit``.

    Example:
        >>> add = compiled(lambda a, b: a + b)
        >>> add(1, 2)
        3
    """
    always = {"nogil": True, "error_model": "numpy", **options}

    def decorated(one: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **always)(one)
        except RuntimeError:  # numba finds no folder
            return numba.njit(**always)(one)

    return decorated if function is None else decorated(function)
