"""The exception for bad input, and how values of a damaged file are shown in its message."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from contextlib import contextmanager

LONGEST_MESSAGE = 1000
"""A message has at most so many characters; of a longer one, which quotes a damaged file, the middle is left out."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlong = 2, 80, 80, 40


class InputError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence: which file, what is wrong with it, and what to do. The command line prints it without
    a traceback and exits with status 2. Whatever a file's name or content puts into it, it stays one line.
    """

    def __str__(self) -> str:
        text = "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in super().__str__())
        if len(text) <= LONGEST_MESSAGE:
            return text
        half = LONGEST_MESSAGE // 2 - 3
        return f"{text[:half]} ... {text[-half:]}"


@contextmanager
def one_sentence() -> Iterator[None]:
    """In nerfstudio's commands: InputError in the block ends the process with its sentence, without a traceback.

    Raises:
        SystemExit: there was one.
    """
    try:
        yield
    except InputError as error:
        raise SystemExit(f"hsi-sc-nerf: {error}") from error


def shown(value: object) -> str:
    """``repr`` of a file's value, shortened: values may be nested, long, or have more digits than Python writes.

    Example:
        >>> shown([[[1]]]), shown("a" * 100)[:10]
        ('[[...]]', "'aaaaaaaaa")
    """
    if isinstance(value, int) and abs(value) >= 10**40:
        return "a number of more than 40 digits"
    return _SHORT.repr(value)
